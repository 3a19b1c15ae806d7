"""ROS bags and MCAP files: `tacpipe ingest rosbag` and `tacpipe ingest mcap`.

A bag is read in one pass, from its first byte on (`ros_files`): no index is needed, so a file that was cut off gives what is
in it. Messages of a topic are decoded together rather than one by one (`wire`): those whose lengths agree have every value
at the same place, so a column is a view of their bytes. What the values measure follows from the message type (`meanings`).
"""
