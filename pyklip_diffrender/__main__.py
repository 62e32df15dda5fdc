"""``python -m pyklip_diffrender``, the same as ``pyklip-diffrender``."""

import sys

from pyklip_diffrender.cli import main

sys.exit(main())
