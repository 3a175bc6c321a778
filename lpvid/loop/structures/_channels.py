"""Whether records have the channels that a structure needs."""

from collections.abc import Collection

from lpvid.data import IOData


def require_channels(
    data: IOData, name: str, *, inputs: int | None, outputs: Collection[int]
) -> None:
    """Complain where there are too many or too few channels.

    Raises:
        ValueError: naming the structure, the channels and the remedy.
    """
    wanted = " or ".join(str(count) for count in outputs)
    for kind, count, fits, there, needed in (
        ("input", data.nu, inputs is None or data.nu == inputs, data.input_names, str(inputs)),
        ("output", data.ny, data.ny in outputs, data.output_names, wanted),
    ):
        if not fits:
            raise ValueError(
                f"data: structure {name!r} needs {needed} {kind}{'' if needed == '1' else 's'}, "
                f"the data has {count} ({', '.join(there)}); choose with data.select, or take "
                f"another structure such as 'black-box'."
            )
