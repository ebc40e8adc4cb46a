"""Do posteriors hold the truth, and how near do they come? TCBI beside every method it is compared with."""

import sys

from main import main

sys.exit(main())
