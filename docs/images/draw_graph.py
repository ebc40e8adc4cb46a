"""Draws graph.svg, the picture of the graph of nodes: `./tcbi python docs/images/draw_graph.py`."""

from pathlib import Path

WIDTH, HEIGHT = 1080, 600
INK, SOFT, PAPER = "#1f2a37", "#5b6776", "#ffffff"
ROBOT, ACT, LEARN, KEEP = "#fbe3c4", "#d8ecf8", "#dff2df", "#eceff3"

# name: (x, y, width, height, colour, title, lines below)
BOXES = {
    "robot": (
        30,
        170,
        230,
        170,
        ROBOT,
        "sim_node  or  driver_node",
        ["MuJoCo, real time or lockstep", "servo bus and sensor board"],
    ),
    "policy": (430, 40, 220, 90, ACT, "policy_node", ["MLP or gait at 5 Hz"]),
    "recorder": (430, 320, 220, 90, KEEP, "recorder_node", ["one bag for each rollout"]),
    "inference": (820, 320, 230, 90, LEARN, "inference_node", ["TCBI on the batch engine;", "posterior, model_error"]),
    "retrain": (820, 40, 230, 90, LEARN, "retrain_node", ["trains in a subprocess"]),
    "bags": (430, 490, 220, 70, PAPER, "bags", ["MCAP: ros2 bag, Foxglove"]),
    "store": (820, 490, 230, 70, PAPER, "store", ["models, posteriors, policies"]),
    "description": (30, 490, 230, 70, KEEP, "description_node", ["robot_description, for RViz"]),
}

# path, label lines, label x, y, anchor, dashed (a service or an action)
ARROWS = [
    ("M 260 195 C 340 185 350 100 430 95", ["joint_states", "imu/data  50 Hz"], 356, 178, "start", False),
    ("M 430 65 C 300 60 160 80 145 170", ["joint_commands  5 Hz"], 250, 58, "end", False),
    (
        "M 260 290 C 330 290 350 345 430 350",
        ["joint_states  imu/data", "foot_contacts  tracker/pose"],
        330,
        262,
        "start",
        False,
    ),
    ("M 430 390 C 330 400 170 400 145 340", ["reset_episode"], 250, 412, "middle", True),
    ("M 540 320 L 540 130", ["policy/enable"], 550, 232, "start", True),
    ("M 650 365 L 820 365", ["rollout/event"], 735, 355, "middle", False),
    ("M 935 320 L 935 130", ["retrain"], 945, 232, "start", True),
    ("M 820 85 L 650 85", ["policy/load"], 735, 75, "middle", True),
    ("M 540 410 L 540 490", [], 0, 0, "", False),
    ("M 650 520 C 740 520 760 430 830 410", [], 0, 0, "", False),
    ("M 935 410 L 935 490", [], 0, 0, "", False),
]


def box(x: int, y: int, width: int, height: int, colour: str, title: str, lines: list[str]) -> str:
    """A rounded box with a title and smaller lines."""
    middle, first = x + width / 2, y + height / 2 - 9 * len(lines) + 2
    parts = [f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="10" fill="{colour}" stroke="{INK}"/>']
    parts.append(f'<text x="{middle}" y="{first:.0f}" class="title">{title}</text>')
    parts += [
        f'<text x="{middle}" y="{first + 22 + 19 * i:.0f}" class="line">{line}</text>' for i, line in enumerate(lines)
    ]
    return "\n".join(parts)


def arrow(path: str, label: list[str], x: int, y: int, anchor: str, dashed: bool) -> str:
    """A curve with a head, and what travels along it."""
    dash = ' stroke-dasharray="6 4"' if dashed else ""
    parts = [f'<path d="{path}" class="arrow"{dash} marker-end="url(#head)"/>']
    for i, line in enumerate(label):
        parts.append(f'<text x="{x}" y="{y + 17 * i}" class="label" text-anchor="{anchor}">{line}</text>')
    return "\n".join(parts)


def picture() -> str:
    """The whole SVG."""
    style = (
        "text{font-family:Helvetica,Arial,sans-serif}"
        f".title{{font-size:17px;font-weight:600;text-anchor:middle;fill:{INK}}}"
        f".line{{font-size:14px;text-anchor:middle;fill:{SOFT}}}"
        f".label{{font-size:13.5px;fill:{INK};font-family:Menlo,Consolas,monospace}}"
        f".arrow{{fill:none;stroke:{INK};stroke-width:1.6}}"
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">',
        "<title>Nodes and topics of tcbi</title>",
        f"<style>{style}</style>",
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" orient="auto">'
        f'<path d="M 0 0 L 10 5 L 0 10 z" fill="{INK}"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="12" fill="{PAPER}"/>',
    ]
    parts += [arrow(*a) for a in ARROWS]
    parts += [box(*b) for b in BOXES.values()]
    parts.append(f'<text x="{WIDTH - 30}" y="{HEIGHT - 14}" class="line" style="text-anchor:end">'
                 "solid: topics and files, dashed: services and actions</text>")  # fmt: skip
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    Path(__file__).with_name("graph.svg").write_text(picture())
