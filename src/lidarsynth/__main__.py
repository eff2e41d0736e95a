"""The command `lidarsynth`, and `python -m lidarsynth`."""

import sys


def command() -> None:
    """Run the command line; Ctrl-C while the program is still being read ends it quietly, too."""
    try:
        from lidarsynth.cli.main import main

        main()
    except KeyboardInterrupt:
        print("lidarsynth: stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    command()
