"""Entry of the benchmark: what it does stands in main.py."""

import sys

from main import main

sys.exit(main())
