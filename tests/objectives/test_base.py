"""Values that objectives look up now and then."""

import torch

from evsplat.objectives.base import LookedUp

CPU = torch.device("cpu")


class Found(LookedUp):
    """Knows in which step its value was looked up."""

    name = "found"

    def __init__(self) -> None:
        super().__init__(refresh=3)
        self.step = 0

    def ask(self) -> int:
        self.step += 1
        return int(self.looked_up(lambda: torch.tensor([[self.step]]), CPU))


def test_a_value_is_looked_up_every_so_many_steps_and_when_rows_have_changed():
    found = Found()
    assert [found.ask() for _ in range(7)] == [1, 1, 1, 4, 4, 4, 7]
    found.rows_changed()
    assert [found.ask() for _ in range(4)] == [8, 8, 8, 11]


def test_a_resume_looks_up_when_the_uninterrupted_training_does():
    for stopped in range(1, 6):
        whole, first, second = Found(), Found(), Found()
        expected = [whole.ask() for _ in range(9)]
        told = [first.ask() for _ in range(stopped)]
        second.load_state(first.state())
        second.step = stopped
        assert told + [second.ask() for _ in range(9 - stopped)] == expected
