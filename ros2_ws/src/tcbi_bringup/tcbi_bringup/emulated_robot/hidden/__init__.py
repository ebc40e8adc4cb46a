"""What can be hidden in an emulated robot, by the part of the robot that it sits in."""
