"""System specs of any size, as TOML: a random fault tree with a mechanism on every event.

They are the shipped system in shape: a mechanism listens to a detection module of its own, several
share a recovery, and recoveries higher in the tree are safer.
"""

from __future__ import annotations

import random

_HEAD = '''name = "synthetic"
title = "{mechanisms} mechanisms, {recoveries} recoveries"

[robot]
length_m = 0.72
width_m = 0.614
top_speed_mps = 1.0
top_turn_rate_radps = 2.0
hardware_speed_mps = 3.0
acceleration_mps2 = 2.0
braking_mps2 = 2.0
stop_distance_m = 0.8
lateral_distance_m = 0.3
sensing_range_m = 5.0
gps_accuracy_m = 0.05
corridor_clearance_m = 1.5

[[node]]
name = "manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"
'''


def synthetic_system(mechanisms: int, recoveries: int, seed: int = 1) -> str:
    """Return a sound system spec.

    Args:
        mechanisms: How many, each on an event of its own; at least as many as recoveries.
        recoveries: How many; the first is the last resort, alone at the root.
        seed: Of the tree's shape.
    """
    if not 2 <= recoveries <= mechanisms:
        raise ValueError(f"{recoveries} recoveries: from 2 to {mechanisms}, the mechanisms")
    chance = random.Random(seed)
    parent = [-1] + [chance.randrange(max(0, i - 1 - i // 2), i) for i in range(1, mechanisms)]
    # Whatever is above in the tree has a lower number, so its recovery is the same or safer.
    runs = [0] + [1 + (i - 1) * (recoveries - 1) // (mechanisms - 1) for i in range(1, mechanisms)]
    lines = [_HEAD.format(mechanisms=mechanisms, recoveries=recoveries)]
    for i in range(mechanisms):
        below = [f'"E{k}"' for k in range(i + 1, mechanisms) if parent[k] == i]
        lines += [
            f'[[detection]]\nname = "D{i}"\ntitle = "D{i}"\nactor = "a.b:C"\nwithin_s = 0.1',
            f'[[mechanism]]\nname = "F{i}"\ndetect = "D{i}"\nrecover = "R{runs[i]}"\n'
            f'event = "E{i}"',
            f'[[event]]\nname = "E{i}"' + (
                f'\ngate = "or"\nof = [{", ".join(below)}]' if below else "")]
    for j in range(recoveries):
        repairs = j > recoveries // 2
        claims = "brakes" if j == 0 else f"part_{j}" if repairs else "actuation"
        lines.append(
            f'[[recovery]]\nname = "R{j}"\ntitle = "R{j}"\nactor = "a.b:C"\n'
            f'kind = "{"masking" if repairs else "forward"}"\nclaims = ["{claims}"]\n'
            f'latched = {"true" if j == 0 else "false"}')
    # A binary tree of recoveries: some are in order, many are not, as in the paper's figure 8b.
    lines.append("[orders.safer]")
    for j in range(recoveries):
        lower = [f'"R{k}"' for k in (2 * j + 1, 2 * j + 2) if k < recoveries]
        if lower:
            lines.append(f"R{j} = [{', '.join(lower)}]")
    return "\n".join(lines) + "\n"
