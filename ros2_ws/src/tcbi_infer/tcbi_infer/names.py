"""Topics of this package that the contract leaves open."""

DISTANCE = "rollout/distance"  # std_msgs/Float64, m: the operator's entry after a rollout without a tracker
