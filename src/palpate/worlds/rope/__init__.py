"""A rope held by a gripper, in MuJoCo."""
