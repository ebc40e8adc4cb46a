"""Topics and services of this package that the contract leaves open."""

DISTANCE = "rollout/distance"  # std_msgs/Float64, m: the operator's entry after a rollout without a tracker
PLACE_ROBOT = "place_robot"  # ResetEpisode: whoever tilts the ground and sets the blocks; optional
