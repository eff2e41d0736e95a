"""`python -m lidarsynth`."""

from lidarsynth.cli import main

main()
