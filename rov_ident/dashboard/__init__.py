"""The live page: what it shows (`store`), and how it is served to this computer alone (`server`).

No ROS here: `nodes/watch_node.py` fills the store.
"""
