"""`python -m lidarsynth`."""

from lidarsynth.cli.main import main

main()
