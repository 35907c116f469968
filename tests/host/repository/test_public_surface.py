"""The names that users depend on change only on purpose: the public surface equals the stored one."""

from public_surface import ADVICE, differences, public_surface, read_surface


def test_public_surface_is_the_stored_one() -> None:
    lines = differences(read_surface(), public_surface())
    assert not lines, "\n".join([*lines, ADVICE])


def test_differences_are_told_apart() -> None:
    old = {"codes": {"Status.OK": "0", "Status.LOST": "2"}, "settings": {"key seed": "int = 0"}}
    new = {"codes": {"Status.OK": "1", "Status.GONE": "2"}, "settings": {"key seed": "int = 0"}}
    assert differences(old, new) == [
        "codes: removed: Status.LOST: 2",
        "codes: added: Status.GONE: 2",
        "codes: changed: Status.OK: 0 -> 1",
    ]
    assert not differences(old, old)
