"""A small offset of clocks and a small rotation between depth and events, estimated from the data itself."""

from edslam_ti.datasets import EventDepthSequence, WrappedSequence


class ShiftedDepth(WrappedSequence):
    """A sequence whose depth was taken `delay` seconds before its stamps say."""

    def __init__(self, sequence: EventDepthSequence, delay: float) -> None:
        super().__init__(sequence)
        self.depth_timestamps = sequence.depth_timestamps - delay
