"""The program `jawusd`, also as ``python -m jawusd``."""

from __future__ import annotations

from jawusd.base import guard


def main() -> None:
    """Run the command line in a process with limits; see `jawusd.base.guard`."""
    guard.run_in_child()
    from jawusd.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
