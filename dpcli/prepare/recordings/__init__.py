"""This folder holds what reads recordings of robots: ROS 1 and ROS 2 bags and MCAP files, through rosbags.

`recording` opens them and yields messages, `messages` makes clouds, depth and calibrations of these.
"""
