"""The message types of a bag: their full text, their hashes, and how their bytes are read and written.

Nothing here needs ROS: the standard types come with `rosbags`, the project's own stand below (a test compares them
with the .msg files). Bytes from elsewhere are decoded with the definition that their own file carries.
"""

import functools
from typing import Any, Literal

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from tcbi_contract import names
from tcbi_infer.errors import BagError

MESSAGES = {  # relative topic -> type, as the contract says
    names.JOINT_STATES: "sensor_msgs/msg/JointState",
    names.IMU: "sensor_msgs/msg/Imu",
    names.FOOT_CONTACTS: "tcbi_msgs/msg/FootContacts",
    names.JOINT_COMMANDS: "trajectory_msgs/msg/JointTrajectory",
    names.TRACKER_POSE: "geometry_msgs/msg/PoseStamped",
    names.ROLLOUT_EVENT: "tcbi_msgs/msg/RolloutEvent",
    names.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}

OWN_TYPES = {
    "tcbi_msgs/msg/FootContacts": """\
std_msgs/Header header
string[] name
bool[] contact
float32[] force
""",
    "tcbi_msgs/msg/Block": """\
geometry_msgs/Point center
geometry_msgs/Vector3 size
float64 yaw
""",
    "tcbi_msgs/msg/RolloutEvent": """\
uint8 BEGIN=0
uint8 END=1
uint8 ABORT=2
std_msgs/Header header
string rollout_id
uint8 kind
string task
string policy_id
string source
float64 slope_roll
float64 slope_pitch
tcbi_msgs/Block[] blocks
float64 distance
string note
""",
}


@functools.cache
def typestore() -> Typestore:
    """The contract's types, of ROS 2 Jazzy."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict = {}
    for name, text in OWN_TYPES.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@functools.cache
def definition(message_type: str) -> str:
    """The `ros2msg` text of a type with the text of every nested type."""
    return typestore().generate_msgdef(message_type, ros_version=2)[0]


@functools.cache
def type_hash(message_type: str) -> str:
    """The RIHS01 hash by which ROS names this version of a type."""
    return typestore().hash_rihs01(message_type)


def prepare() -> None:
    """Work out all of the contract's definitions now, which takes a while, instead of when a robot waits for them."""
    for message_type in MESSAGES.values():
        definition(message_type)
        type_hash(message_type)


@functools.cache
def _store_of(message_type: str, encoding: str, text: str) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    if encoding == "ros2idl":
        store.register(get_types_from_idl(text))
    else:
        store.register(get_types_from_msg(text, message_type))
    return store


def store_for(message_type: str, encoding: str, text: str) -> Typestore:
    """A store that decodes `message_type` by the definition a file carries.

    Raises:
      BagError: the definition is missing or cannot be parsed.
    """
    if encoding not in ("ros2msg", "ros2idl") or not text:
        raise BagError(
            f"{message_type}: the file describes it as {encoding or 'nothing'!r}, allowed are ros2msg and ros2idl; "
            "record it with a ROS 2 recorder that writes MCAP"
        )
    try:
        return _store_of(message_type, encoding, text)
    except Exception as e:
        raise BagError(f"{message_type}: its definition in the file cannot be parsed ({e})") from e


def decode(data: bytes, message_type: str, encoding: str, text: str) -> Any:
    """One message from its CDR bytes."""
    return store_for(message_type, encoding, text).deserialize_cdr(data, message_type)


def encode(message: Any, message_type: str) -> bytes:
    """CDR bytes of a message of the contract."""
    return bytes(typestore().serialize_cdr(message, message_type))


def stamp_of(data: bytes) -> int | None:
    """The header stamp (ns) of a serialized message whose first field is a `std_msgs/Header`, or None if too short."""
    if len(data) < 12:
        return None
    order: Literal["little", "big"] = "little" if data[1] & 1 else "big"
    return int.from_bytes(data[4:8], order, signed=True) * 1_000_000_000 + int.from_bytes(data[8:12], order)
