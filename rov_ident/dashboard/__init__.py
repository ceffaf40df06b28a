"""The live page: what it shows (`store`, which `nodes/watch_node.py` fills), and how it is served
to this computer alone (`server`)."""
