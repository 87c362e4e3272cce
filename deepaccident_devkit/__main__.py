"""`python -m deepaccident_devkit`: the same as `deepaccident`."""

from deepaccident_devkit.cli import main

if __name__ == "__main__":
    main()
