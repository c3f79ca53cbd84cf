"""This folder holds what reads recordings of robots: ROS 1 and ROS 2 bags through rosbags, and MCAP files.

`recording` opens them and yields messages, `bags` reads bags, `mcap` MCAP and `foxglove` its messages that are not of ROS,
`ros_types` knows the types of those that are, `messages` makes clouds, depth and calibrations of them all.
"""
