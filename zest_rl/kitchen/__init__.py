"""One robot, six tasks: the environment, its experts, how they are recorded, and how the scene is drawn."""
