"""One robot, six tasks: the environment, its experts, and how they are recorded."""
