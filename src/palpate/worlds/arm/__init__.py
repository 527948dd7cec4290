"""A seven-axis arm with a gripper, its wrist's sensor and its control, in MuJoCo; and its maze."""
