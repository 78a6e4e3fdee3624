"""Data that come from cameras and other processes while they are tracked: `edslam live`."""
