"""`python -m lidarsynth`."""

import sys

try:
    from lidarsynth.cli.main import main

    main()
except KeyboardInterrupt:  # while the program was still being read
    sys.exit(130)
