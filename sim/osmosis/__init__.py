"""The world of Osmosis in MuJoCo: Summit XL, sensors, judge, report.

A run opens no window, so MuJoCo is imported without a way to render: GLFW would start a process to
look for its library. `rampart replay` chooses a way with `MUJOCO_GL` before it imports this
package.
"""

import os

if "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = "disable"
    import mujoco as mujoco

    del os.environ["MUJOCO_GL"]  # processes of the run may render
