"""`python -m flexgs_edge`: the same as the command `flexgs-edge`."""

from flexgs_edge.cli.app import main

if __name__ == "__main__":
    main()
