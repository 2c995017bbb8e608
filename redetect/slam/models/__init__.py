"""Motion and measurement of a robot on the floor, with Jacobians, and the noise of its odometry.

- `motion`: composition of poses.
- `measurement`: discs and lines as a pose sees them.
- `mounting`: rows as a differently mounted camera would have written them.
- `odometry_noise`: assumed where a source states no covariance.
"""
