"""What the kernel of this machine knows of its processes, and does for them."""
