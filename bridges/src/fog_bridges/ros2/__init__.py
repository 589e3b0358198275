"""ROS 2 by the wire of rmw_zenoh, without a ROS installation."""
