"""The arbiter of the fault-tolerance mechanisms: pure, and importing nothing of the project.

From a system spec to a decision and its certificate:

    spec = parse_specification(text, "systems/osmosis.toml")
    decide(["FTM3", "FTM4"], spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order())

From reports to commands: `build_arbiter(spec)`, then `step` by `step` (`manager.arbiter`).
"""

from manager.arbiter import Arbiter, State, build_arbiter
from manager.budget import Budget, check, derive_timeouts
from manager.decision import Decision, Strategy
from manager.fault_tree import FaultTree
from manager.mechanisms import Contract, Mechanism, Mechanisms, RecoveryKind
from manager.order import PartialOrder, Tree
from manager.specification import SpecificationError, SystemSpec, parse_specification
from manager.strategies import STRATEGIES, decide, find_strategy, register

__all__ = [
    "STRATEGIES", "Arbiter", "Budget", "Contract", "Decision", "FaultTree", "Mechanism",
    "Mechanisms", "PartialOrder", "RecoveryKind", "SpecificationError", "State", "Strategy",
    "SystemSpec", "Tree", "build_arbiter", "check", "decide", "derive_timeouts", "find_strategy",
    "parse_specification", "register",
]
