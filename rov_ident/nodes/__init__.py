"""ROS: nodes, their parameters, topics and services, and the player of bags. The only room that
knows rclpy; what can be done without ROS belongs in another one."""
