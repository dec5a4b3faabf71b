"""Run by the Python that has the wheels of ROS 2: the lifecycle node /camera in rclpy.

It adds a line to the file FILE for each transition: its process id, the state, and the time.

    python rclpy_camera.py FILE
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Camera(LifecycleNode):
    """A node with states."""

    def on_configure(self, state):
        return self.note("inactive")

    def on_activate(self, state):
        super().on_activate(state)
        return self.note("active")

    def note(self, state):
        with Path(sys.argv[1]).open("a", encoding="utf-8") as file:
            file.write(f"{os.getpid()} {state} {time.time()}\n")
        return TransitionCallbackReturn.SUCCESS


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Camera("camera"))
