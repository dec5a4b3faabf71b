"""placeholder until below"""
from actors.runtime.actor import Actor
class Observer(Actor):
    """x"""
