"""`python -m jaxilc` is the command `jaxilc`, also where the folder of scripts is in no PATH."""

from .cli import main

if __name__ == "__main__":
    main()
