"""A live path: synchronized frames of a running system in, the static scene out while it happens.

transport.py   what a middleware must do; ros.py (rclpy) and dds.py (CycloneDDS) do it
messages.py    the ROS messages that pass through, the same for both; cdr.py their bytes
grouper.py     which messages belong to one instant
latest.py      the short queue before the method, in which the newer displaces the older
figures.py     what came, what was dropped and why, how long it took
server.py      from the messages of one instant to those of the static scene
"""
