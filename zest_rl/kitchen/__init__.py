"""One robot, six tasks: the environment, its experts, their recordings, and the rendered scene."""
