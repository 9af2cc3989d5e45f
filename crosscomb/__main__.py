"""``python -m crosscomb`` is the command line."""

from crosscomb.cli.main import main

if __name__ == "__main__":
    main()
