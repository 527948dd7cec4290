"""From a trained policy to a robot: export, messages, a real-time loop that fails closed."""
