"""This folder holds what reads recordings of robots: ROS 1 and ROS 2 bags through rosbags, and MCAP files.

`recording` opens them and yields messages, `mcap` reads MCAP and `foxglove` its messages that are not of ROS, `messages` makes
clouds, depth and calibrations of them all.
"""
