"""What `./tcbi` does on first use: virtual environment, ROS wheels, colcon build. Standard library only.

Every step is recorded when it is complete and is done again from a clean start when it was not, so that an interrupted
set-up heals on the next call.
"""
