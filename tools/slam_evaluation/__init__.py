"""How good maps, localisation and association are, on runs whose truth is known.

python -m tools.slam_evaluation map RUN...
"""
