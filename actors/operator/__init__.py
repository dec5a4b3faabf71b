"""The operator's side: the HMI with its page, and teleoperation."""
