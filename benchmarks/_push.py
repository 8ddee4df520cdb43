"""A push. A system of a script itself cannot be sent to workers; from a module they import it."""

from collections.abc import Sequence

from pydrake.systems.framework import BasicVector, Context, LeafSystem


class Push(LeafSystem):
    """Force on the plate's centre of mass; output `wrench` (6): moment (N m), force (N)."""

    def __init__(self, force: Sequence[float], span: tuple[float, float]) -> None:
        super().__init__()
        self.force, self.span = force, span
        self.DeclareVectorOutputPort("wrench", 6, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        pushed = self.span[0] <= context.get_time() < self.span[1]
        output.SetFromVector([0.0] * 3 + [float(f) if pushed else 0.0 for f in self.force])
