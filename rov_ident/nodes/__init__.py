"""ROS: the nodes, their parameters, topics and services, and the player of bags.

The only room that knows rclpy. A node declares parameters, converts messages, steps an estimator,
publishes; anything that could be done without ROS belongs in another room.
"""
