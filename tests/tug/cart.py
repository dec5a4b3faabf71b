from rampart import Actor, Header, Message, Qos, Topic, every, on


class Speed(Message):
    """How fast the tug is to be."""

    speed_mps: float
    turn_radps: float


class Wheels(Message):
    """How fast the wheels are to turn."""

    left_radps: float
    right_radps: float


COMMAND = Topic("tug/command", Speed, Qos.SENSOR, 10.0, "base_link", "Speed of the tug.")
WHEELS = Topic("tug/wheels", Wheels, Qos.SENSOR, 50.0, "", "Speeds of its wheels.")


class Driver(Actor):
    """Drives straight on, and remembers how the wheels turn."""

    outputs = (COMMAND,)
    seen = None

    @every(0.1)
    def drive(self) -> None:
        """Say how fast."""
        self.publish(COMMAND, Speed(0.5, 0.0))

    @on(WHEELS)
    def wheels(self, message: Wheels, _header: Header) -> None:
        """Hear the wheels."""
        self.seen = message


class VirtualWheels(Actor):
    """Plays the wheels in virtual time."""

    outputs = (WHEELS,)
    speed_mps = 0.0

    @on(COMMAND)
    def command(self, message: Speed, _header: Header) -> None:
        """Take a speed."""
        self.speed_mps = message.speed_mps

    @every(0.02)
    def turn(self) -> None:
        """Say how fast they turn."""
        self.publish(WHEELS, Wheels(self.speed_mps / 0.1, self.speed_mps / 0.1))
