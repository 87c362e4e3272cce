"""Run `deepaccident` as `python -m deepaccident_devkit`."""

from deepaccident_devkit.cli import main

if __name__ == "__main__":
    main()
