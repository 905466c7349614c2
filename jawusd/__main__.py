"""Run the command line with ``python -m jawusd``."""

from jawusd.cli.main import main

if __name__ == "__main__":
    main()
