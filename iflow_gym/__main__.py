"""``python -m iflow_gym`` is the command ``iflow-gym``."""

from iflow_gym.cli import main

if __name__ == "__main__":
    main()
