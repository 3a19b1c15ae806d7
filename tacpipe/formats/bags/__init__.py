"""ROS bags and MCAP files: `tacpipe ingest rosbag` and `tacpipe ingest mcap`.

`ros_files` reads a bag in one pass from its first byte. It needs no index, so truncated files are readable up to the
cut. `wire` decodes the messages of a topic together: messages of equal lengths have every value at the same offset, so
a column is a view of their bytes. `meanings` derives quantities and units from the message type.
"""
