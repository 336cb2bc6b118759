"""The jobs as ordered steps, one module a subcommand of the command line.

Functions are imported from their modules (or from `flexgs_edge`): a name here would hide the module of the same name.
"""
