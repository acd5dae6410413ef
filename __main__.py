"""The command line: `sideslip` and `python -m sideslip`."""

from .benchmarks.cli.main import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
