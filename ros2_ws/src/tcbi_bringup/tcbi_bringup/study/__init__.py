"""Does it transfer? The paper's experiment, on emulated robots and faster than real time."""
