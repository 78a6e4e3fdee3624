"""Sequences on disk: one file per format, one dictionary of formats."""

from edslam_ti.datasets.base import EventDepthSequence, Sample, SampledSequence

__all__ = ["EventDepthSequence", "Sample", "SampledSequence"]
