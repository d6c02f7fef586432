"""``python -m thermal_fiducial COMMAND``."""

import sys

from thermal_fiducial.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
