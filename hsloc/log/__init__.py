"""THE ONE DOOR to MCAP, ROS bags and CARMEN.

`open_log` gives events of the model from whatever holds a recording; `LogWriter` writes them down so that every
tool of the field can read them.
"""
