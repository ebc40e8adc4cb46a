"""The mapping file of an import: which column of a log is which signal of which rig. TOML; docs/bags.md explains it."""

import math
import tomllib
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

from tcbi_infer.errors import MappingError
from tcbi_infer.readings import QUANTITIES, is_reading
from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.rig import Rig
from tcbi_sim.rigs import load_rig

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNITS = {"rad": 1.0, "deg": math.pi / 180, "turn": 2 * math.pi, "N m": 1.0}
TOP = {"rig", "joints", "task", "source", "policy", "entries", "window", "constants"}
TOP |= {"time", "position", "command", "torque_on", "readings", "contact"}
BODY: dict[str, tuple[int, dict[str, float]]] = {  # signals of a robot's body: how many values, and their units
    "attitude": (4, {"1": 1.0}),  # a quaternion
    "roll_pitch_yaw": (3, {"rad": 1.0, "deg": math.pi / 180}),  # the attitude in three angles, in its place
    "angular_velocity": (3, {"rad/s": 1.0, "deg/s": math.pi / 180}),
    "linear_acceleration": (3, {"m/s^2": 1.0, "g": 9.80665}),
    "tracker": (3, {"m": 1.0, "mm": 1e-3}),
}
ORDERS = ("wxyz", "xyzw")  # of a quaternion
TOP |= set(BODY)
SIGNAL = {"column", "columns", "file", "time", "unit", "scale", "offset", "list", "pick"}


@dataclass(frozen=True)
class Signal:
    """Where a signal is in a log, and how it becomes SI units: value * scale + offset."""

    columns: tuple[str, ...]
    file: str = ""  # in the log's folder; empty: the log is one file
    time: str = ""  # its own time column; empty: the mapping's
    listed: bool = False  # one column holds a list with all joints
    pick: tuple[int, ...] = ()  # which values of the list; empty: all
    scale: tuple[float, ...] | float = 1.0
    offset: tuple[float, ...] | float = 0.0


@dataclass(frozen=True)
class Mapping:
    """A mapping file, checked."""

    rig: str
    joints: tuple[str, ...]
    position: Signal
    command: Signal | None = None
    torque_on: Signal | None = None
    torque_commands: bool = False  # commands are N m
    ramp: float = 0.0  # s
    time_column: str = "time"
    time_scale: float = 1.0
    entries: str = "entries"
    task: str = "log"
    source: str = "log"
    policy_id: str = ""
    window: float = 0.0  # s, of the pieces that a log is cut into; 0: it stays whole
    constants: tuple[tuple[str, float | str], ...] = field(default=())
    readings: tuple[tuple[str, Signal], ...] = ()  # temperature or voltage, by the name of the reading
    body: tuple[tuple[str, Signal], ...] = ()  # signals of the body, by their names in BODY; a quaternion as w x y z
    feet: tuple[str, ...] = ()
    contact: Signal | None = None  # above 0.5 where a foot stands

    def is_log(self, path: Path) -> bool:
        """Whether this path looks like a log of this mapping."""
        if self.position.file:
            return path.is_dir() and any((path / f"{self.position.file}{end}").is_file() for end in ("", ".gz"))
        return path.is_file() and path.name.removesuffix(".gz").endswith((".json", ".csv"))


def built_in() -> dict[str, str]:
    """Name and text of the mappings that come with the project."""
    folder = resources.files("tcbi_infer") / "mappings"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name.removesuffix(".toml"): f.read_text(encoding="utf-8") for f in files}


def load_mapping(name: str | Path) -> Mapping:
    """A mapping file, or a built-in mapping by name.

    Raises:
      UnknownNameError: there is none.
      MappingError: everything that is wrong in it, at once.
    """
    path = Path(name)
    known = built_in()
    if path.is_file():
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as e:
            raise MappingError(f"{path}: cannot be read ({e})") from e
    elif str(name) in known:
        text = known[str(name)]
    else:
        raise UnknownNameError("mapping file or built-in mapping", str(name), tuple(known))
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise MappingError(f"{name}: is no TOML ({e})") from e
    return _Checker(str(name), content).mapping()


class _Checker:
    """Collects everything that is wrong, then raises once."""

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        self.name, self.content = name, content
        self.faults = [f"unknown key {key!r}" for key in sorted(set(content) - TOP)]

    def mapping(self) -> Mapping:
        c = self.content
        self.rig = self._rig(self._text("rig", required=True))
        joints = c.get("joints")
        if not (isinstance(joints, list) and joints and all(isinstance(j, str) for j in joints)):
            self.faults.append(f"joints: got {joints!r}, allowed is a list of names")
            joints = ["joint"]
        elif self.rig:
            self._check_joints(self.rig, joints)
        time = self._section("time", {"column", "unit"})
        time_column = self._name("column", time, "time.column", "time")
        time_scale = self._unit(time, "time.unit", "s", TIME_UNITS)
        position = self._signal("position", len(joints)) or Signal(("position",))
        if "position" not in c:
            self.faults.append("the section [position] is missing")
        command = self._signal("command", len(joints), {"kind", "ramp"})
        commanded = self._section("command", SIGNAL | {"kind", "ramp"}, report=False)
        kind = commanded.get("kind", "position")
        if kind not in ("position", "torque"):
            self.faults.append(f"command.kind: got {kind!r}, allowed is position or torque")
        feet, contact = self._contact()
        mapping = Mapping(
            rig=self.rig.name if self.rig else "",
            joints=tuple(joints),
            position=position,
            command=command,
            torque_on=self._signal("torque_on", 1),
            torque_commands=kind == "torque",
            ramp=self._not_negative("ramp", commanded, "command.ramp"),
            time_column=time_column,
            time_scale=time_scale,
            entries=self._text("entries", "entries"),
            task=self._text("task", "log"),
            source=self._text("source", "log"),
            policy_id=self._text("policy", ""),
            window=self._window(),
            constants=self._constants(),
            readings=self._readings(joints),
            body=self._body(),
            feet=feet,
            contact=contact,
        )
        if self.faults:
            raise MappingError(f"{self.name}: {'; '.join(self.faults)}")
        return mapping

    def _rig(self, name: str) -> Rig | None:
        try:
            return load_rig(name) if name else None
        except SimError as e:
            self.faults.append(f"rig: {e}")
            return None

    def _check_joints(self, rig: Rig, joints: list[str]) -> None:
        if missing := [joint for joint in rig.joint_names if joint not in joints]:
            self.faults.append(
                f"joints: got {', '.join(joints)}; the rig {rig.name!r} has {', '.join(rig.joint_names)}, of which "
                f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
            )

    def _text(self, key: str, default: str = "", required: bool = False) -> str:
        value = self.content.get(key, default)
        if not isinstance(value, str) or (required and not value):
            self.faults.append(f"{key}: got {value!r}, allowed is a name")
            return default
        return value

    def _section(self, key: str, allowed: set[str], report: bool = True) -> dict[str, Any]:
        section = self.content.get(key, {})
        if not isinstance(section, dict):
            if report:
                self.faults.append(f"{key}: got {section!r}, allowed is a section with {', '.join(sorted(allowed))}")
            return {}
        if report:
            self.faults += [f"{key}: unknown key {k!r}" for k in sorted(set(section) - allowed)]
        return section

    def _body(self) -> tuple[tuple[str, Signal], ...]:
        """The signals of the body that the mapping has."""
        if {"attitude", "roll_pitch_yaw"} <= set(self.content):
            self.faults.append("attitude and roll_pitch_yaw: both say how the body is turned, allowed is one of them")
        found = []
        for key, (width, units) in BODY.items():
            signal = self._signal(key, width, {"order"} if key == "attitude" else None, units)
            if signal is not None:
                found.append((key, self._as_wxyz(signal) if key == "attitude" else signal))
        return tuple(found)

    def _as_wxyz(self, signal: Signal) -> Signal:
        order = self._section("attitude", set(), report=False).get("order", ORDERS[0])
        if order not in ORDERS:
            self.faults.append(f"attitude.order: got {order!r}, allowed is {' or '.join(ORDERS)}")
        if order != "xyzw":
            return signal
        if signal.listed:
            x, y, z, w = signal.pick or (0, 1, 2, 3)
            return replace(signal, pick=(w, x, y, z))
        return replace(signal, columns=(signal.columns[3], *signal.columns[:3]))

    def _contact(self) -> tuple[tuple[str, ...], Signal | None]:
        """The feet whose contacts are in the log, and where; what counts as contact becomes 1."""
        if "contact" not in self.content:
            return (), None
        section = self._section("contact", SIGNAL | {"feet", "threshold"}, report=False)
        known = self.rig.foot_names if self.rig else ()
        feet = section.get("feet", list(known))
        if not isinstance(feet, list) or not feet or set(feet) != set(known):
            self.faults.append(
                f"contact.feet: got {feet!r}, allowed are the feet of the rig: {', '.join(known) or '–'}"
            )
            feet = ["foot"]
        threshold = section.get("threshold", 0.5)
        if not isinstance(threshold, (int, float)) or isinstance(threshold, bool) or not 0 < threshold < math.inf:
            self.faults.append(f"contact.threshold: got {threshold!r}, allowed is a number above 0")
            threshold = 0.5
        signal = self._signal("contact", len(feet), {"feet", "threshold"}, {"1": 0.5 / threshold, "N": 0.5 / threshold})
        return tuple(feet), signal

    def _signal(
        self, key: str, joints: int, more: set[str] | None = None, units: dict[str, float] = UNITS
    ) -> Signal | None:
        if key not in self.content:
            return None
        section = self._section(key, SIGNAL | (more or set()))
        columns = section.get("columns", [section["column"]] if "column" in section else [])
        listed = section.get("list", False)
        if not isinstance(listed, bool):
            self.faults.append(f"{key}.list: got {listed!r}, allowed is true or false")
            listed = False
        expected = 1 if listed else joints
        if not isinstance(columns, list) or len(columns) != expected or not all(isinstance(c, str) for c in columns):
            self.faults.append(f"{key}.columns: got {columns!r}, allowed is a list of {expected} names")
            columns = [""] * expected
        unit = self._unit(section, f"{key}.unit", next(iter(units)), units)
        return Signal(
            columns=tuple(columns),
            file=self._name("file", section, f"{key}.file"),
            time=self._name("time", section, f"{key}.time"),
            listed=listed,
            pick=self._pick(section, f"{key}.pick"),
            scale=self._factor(section.get("scale", 1.0), f"{key}.scale", joints, unit),
            offset=self._factor(section.get("offset", 0.0), f"{key}.offset", joints, unit),
        )

    def _name(self, key: str, section: dict[str, Any], what: str, default: str = "") -> str:
        value = section.get(key, default)
        if isinstance(value, str):
            return value
        self.faults.append(f"{what}: got {value!r}, allowed is a name")
        return default

    def _unit(self, section: dict[str, Any], what: str, default: str, units: dict[str, float]) -> float:
        value = section.get("unit", default)
        if isinstance(value, str) and value in units:
            return units[value]
        self.faults.append(f"{what}: got {value!r}, allowed is one of {', '.join(units)}")
        return 1.0

    def _pick(self, section: dict[str, Any], what: str) -> tuple[int, ...]:
        value = section.get("pick", [])
        if isinstance(value, list) and all(type(i) is int and i >= 0 for i in value):
            return tuple(value)
        self.faults.append(f"{what}: got {value!r}, allowed is a list of places, the first of them 0")
        return ()

    def _factor(self, value: Any, what: str, joints: int, unit: float = 1.0) -> tuple[float, ...] | float:
        if isinstance(value, (int, float)):
            return value * unit
        if isinstance(value, list) and len(value) == joints and all(isinstance(v, (int, float)) for v in value):
            return tuple(v * unit for v in value)
        self.faults.append(f"{what}: got {value!r}, allowed is a number, or {joints} of them")
        return 1.0

    def _window(self) -> float:
        window = self._not_negative("window", self.content)
        if window and self.rig and self.rig.floating:
            self.faults.append(
                "window: a robot that stands free begins at rest, not in the middle of a log; record short motions"
            )
        return window

    def _not_negative(self, key: str, section: dict[str, Any], name: str = "") -> float:
        value = section.get(key, 0.0)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < math.inf:
            return float(value)
        self.faults.append(f"{name or key}: got {value!r}, allowed is 0 s or more")
        return 0.0

    def _constants(self) -> tuple[tuple[str, float | str], ...]:
        section = self.content.get("constants", {})
        if not isinstance(section, dict):
            self.faults.append(f"constants: got {section!r}, allowed is a section of numbers and keys of the log")
            return ()
        wrong = {k: v for k, v in section.items() if not isinstance(v, (int, float, str)) or isinstance(v, bool)}
        self.faults += [f"constants.{k}: got {v!r}, allowed is a number or a key of the log" for k, v in wrong.items()]
        return tuple((k, v) for k, v in section.items() if k not in wrong)

    def _readings(self, joints: list[str]) -> tuple[tuple[str, Signal], ...]:
        section = self.content.get("readings", {})
        allowed = ", ".join(q.key for q in QUANTITIES)
        if not isinstance(section, dict):
            self.faults.append(f"readings: got {section!r}, allowed is a section with {allowed}")
            return ()
        found = []
        for key, value in section.items():
            where = {"column": value} if isinstance(value, str) else value
            if not is_reading(key, joints):
                self.faults.append(f"readings.{key}: allowed are {allowed}, each also with /<joint> behind it")
            elif (
                not isinstance(where, dict) or set(where) - {"column", "file", "time", "scale"} or "column" not in where
            ):
                self.faults.append(f"readings.{key}: got {value!r}, allowed is a column, or column, file, time, scale")
            else:
                scale = self._factor(where.get("scale", 1.0), f"readings.{key}.scale", 1)
                column, file, time = (self._name(k, where, f"readings.{key}.{k}") for k in ("column", "file", "time"))
                found.append((key, Signal((column,), file, time, scale=scale)))
        return tuple(found)
