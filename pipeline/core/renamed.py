"""Names of earlier versions: plugins, options and words of the command that are accepted for one release, each with a warning.

`rename_plugin` and `rename_options` are called where the plugins are (`plugins/renamed.py`, or a third party's module)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

WORDS = {"experiment=paper_table": "experiment=paper"}
_PLUGINS: dict[tuple[str, str], str] = {}  # (slot, old name) -> name
_OPTIONS: dict[tuple[str, str], dict[str, str | None]] = {}  # (slot, plugin) -> old option -> option, None = removed


def rename_plugin(slot: str, old: str, new: str) -> None:
    """Accept `SLOT=old` as `SLOT=new`."""
    _PLUGINS[slot, old] = new


def rename_options(slot: str, plugin: str, **names: str | None) -> None:
    """Accept options of a plugin by their old names; None for one that was removed and is ignored."""
    _OPTIONS.setdefault((slot, plugin), {}).update(names)


def current_plugin(slot: str, name: str) -> str:
    """Return today's name of a plugin."""
    return _PLUGINS.get((slot, name), name)


def current_option(slot: str, plugin: str, option: str) -> str | None:
    """Return today's name of an option; None for one that was removed."""
    return _OPTIONS.get((slot, plugin), {}).get(option, option)


def current_words(words: Iterable[str], options_of_slot: Callable[[str], dict[str, set[str]]]) -> tuple[list[str], list[str]]:
    """Return words of the command line in today's names, and a warning for each that was changed or dropped.

    `options_of_slot` gives the names of the options by plugin: an option of a plugin that no word names is taken as renamed only where no plugin of
    the slot has it."""
    given = [WORDS.get(word, word) for word in words]
    warnings = [f"{old} is now {new}" for old, new in zip(words, given) if old != new]
    chosen = {slot: current_plugin(slot, name) for slot, _, name in (word.partition("=") for word in given)}
    out: list[str] = []
    for word in given:
        key, equals, value = word.partition("=")
        slot, dot, option = key.lstrip("+").partition(".")
        new: str | None = word
        if (slot, value) in _PLUGINS and not dot:
            new = f"{key}={_PLUGINS[slot, value]}"
        elif equals and dot and any(of == slot and option in names for (of, _), names in _OPTIONS.items()):
            new = _current(word, slot, option, value, chosen.get(slot), options_of_slot(slot))
        if new != word:
            warnings.append(f"{word} is now {new}" if new else f"{key} is no longer an option, and is ignored")
        if new is not None:
            out.append(new)
    return out, warnings


def _current(word: str, slot: str, option: str, value: str, plugin: str | None, options: dict[str, set[str]]) -> str | None:
    """Return one word that sets an option, in today's names; None where the option was removed."""
    if plugin is None and any(option in names for names in options.values()):
        return word
    for name in options if plugin is None else (plugin,):
        found = current_option(slot, name, option)
        if found != option:
            return None if found is None else f"{slot}.{found}={value}"
    return word
