"""``python -m rlightning_aio`` is the command ``rlightning-aio``."""

from rlightning_aio.cli import main

if __name__ == "__main__":
    main()
