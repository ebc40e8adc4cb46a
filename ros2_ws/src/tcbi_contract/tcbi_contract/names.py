"""Topics, frames, joints and limits of the robot, fixed by the contract (see docs/contract.md)."""

import math

LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")
LEG_JOINTS = ("coxa", "femur", "tibia")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in LEG_JOINTS)

JOINT_LIMIT = math.pi / 6  # rad, either side of the neutral stance
SLOPE_LIMIT = math.pi / 6  # rad

BASE_FRAME = "base_link"
IMU_FRAME = "imu_link"
WORLD_FRAME = "world"

SENSOR_RATE_HZ = 50.0
CONTROL_RATE_HZ = 5.0
CONTROL_PERIOD_S = 1.0 / CONTROL_RATE_HZ
DIAGNOSTICS_RATE_HZ = 1.0

# Topics, relative so that a namespace prefixes them; but the clock is one for all
JOINT_STATES = "joint_states"
IMU = "imu/data"
FOOT_CONTACTS = "foot_contacts"
JOINT_COMMANDS = "joint_commands"
TRACKER_POSE = "tracker/pose"
ROLLOUT_EVENT = "rollout/event"
DISTANCE = "rollout/distance"
DIAGNOSTICS = "diagnostics"
ROBOT_DESCRIPTION = "robot_description"
POSTERIOR = "posterior"
POSTERIOR_PROGRESS = "posterior/progress"  # of an inference at work, after each generation: not final
MODEL_ERROR = "model_error"
DIAGNOSIS = "diagnosis"
POLICY_STATUS = "policy/status"
CLOCK = "/clock"

# Services and actions
RESET_EPISODE = "reset_episode"
PLACE_ROBOT = "place_robot"
EMERGENCY_STOP = "emergency_stop"
RELEASE_EMERGENCY_STOP = "emergency_stop/release"
LOAD_MODEL = "load_model"  # of the simulator: what is simulated
INFERENCE_LOAD_MODEL = "inference/load_model"  # of the inference node: whose parameters are inferred
LOAD_POLICY = "policy/load"
ENABLE_POLICY = "policy/enable"
ADD_EFFECT = "add_effect"
COLLECT_ROLLOUTS = "collect_rollouts"
DIAGNOSE = "diagnose"
RETRAIN = "retrain"
