"""Where the modules that only tests share are found."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
