"""Where the data of tests and studies come from: vehicles simulated by other equations than ours,
and a vehicle at the other end of the topics of a live node.
"""
