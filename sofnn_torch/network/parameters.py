"""Parameters that are windows into a table, in lists that grow with the rules."""

from typing import Any, NoReturn, Self

from torch import Tensor, nn

KINDS = ("centres", "widths", "consequents")


class Window(nn.Parameter):
    """A Parameter that shows columns of the table of the rules. It never gets memory of its own.

    ``window.data = values`` writes the values into the table; whatever is written through it or
    its ``data`` counts in ``_version``.
    """

    @property
    def data(self) -> Tensor:
        """The numbers, without a gradient."""
        return self.detach()

    @data.setter
    def data(self, values: Tensor) -> None:
        if values.shape != self.shape:
            raise ValueError(
                f"a block of rules keeps its shape {tuple(self.shape)}, got {tuple(values.shape)}"
            )
        self.detach().copy_(values.detach())

    def view(self, *shape: Any) -> Tensor:
        """As for any tensor; a copy where the columns do not lie side by side in memory."""
        return self.reshape(*shape)

    def show(self, window: Tensor) -> None:
        """Show other memory, of any type and on any device."""
        # The stubs see a tensor where the class has a descriptor.
        nn.Parameter.data.__set__(self, window)  # type: ignore[attr-defined]

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        # A view would be written with all that the table has reserved.
        numbers = self.detach() if self.is_shared() else self.detach().clone()
        return Window, (numbers, self.requires_grad)


class Blocks(nn.ParameterList):
    """One kind of parameters of all rules, block by block; only the table adds and removes.

    Shape of a block: (rows, rules in it).
    """

    def append(self, value: Window) -> Self:
        """Append a window."""
        return super().append(value) if isinstance(value, Window) else self._refuse()

    def pop(self) -> Window:
        """Remove the last window."""
        last: Window = self[-1]
        self._size -= 1
        del self._parameters[str(self._size)]
        return last

    def tensors(self) -> list[Tensor]:
        """The windows, or what `torch.func.functional_call` has put in their places."""
        return list(self._parameters.values())  # type: ignore[arg-type]  # none is None

    def register_parameter(self, name: str, param: nn.Parameter | None) -> None:
        """Refuse what is no window at the end, such as the parts of a pruned parameter."""
        if not isinstance(param, Window) or name != str(self._size - 1):
            self._refuse()
        super().register_parameter(name, param)

    def __delattr__(self, name: str) -> None:
        if name in self._parameters:
            self._refuse()
        super().__delattr__(name)

    def extra_repr(self) -> str:
        """Shape of each block."""
        return ", ".join(str(tuple(block.shape)) for block in self)

    def _refuse(self) -> NoReturn:
        raise ValueError(
            "blocks of parameters are windows into the table of the rules and cannot be exchanged, "
            "pruned or parametrized: write to them in place or use replace_rules()"
        )

    def _save_to_state_dict(
        self, destination: dict[str, Any], prefix: str, keep_vars: bool
    ) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if not keep_vars:  # torch.save would write all that the table has reserved
            for name in self._parameters:
                destination[prefix + name] = destination[prefix + name].clone()

    def _load_from_state_dict(self, *arguments: Any) -> None:
        pass  # the table loads its blocks, all or none
