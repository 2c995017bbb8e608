"""The figures in the README, each printed by a subcommand: ``python -m tools.evaluation
--help``.
"""
