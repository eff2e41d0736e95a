"""The words of a command line become a verb with its arguments; what does not fit becomes a line of ours."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial, wraps
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, Union, cast, get_args, get_type_hints

import tyro

if TYPE_CHECKING:
    from tyro import _errors as events
else:
    try:  # what a refusal is about, as types and fields; tyro may move it some day: then its own text is printed
        from tyro import _errors as events
    except ImportError:
        events = None


def parsed(verbs: Mapping[str, Callable[..., None]], argv: list[str]) -> Callable[[], None]:
    """The verb with its arguments, not yet run.

    Only the verb that is named is given to tyro, which takes as long as there are verbs to describe.

    Raises ValueError that says what was expected and what was found, SystemExit where help was asked for.
    """
    word = argv[0] if argv else "--help"
    if word in verbs:
        _no_empty_word(argv[1:])
        _one_recipe(argv[1:])
        with _refusals(verbs[word]):
            return tyro.cli(_later(verbs[word]), prog=f"lidarsynth {word}", args=argv[1:])
    if not word.startswith("-"):
        raise ValueError(f"expected a verb of {', '.join(verbs)}, found {word!r}{_meant(word, tuple(verbs))}")
    with _refusals(None):
        told = {name: (inspect.getdoc(verb) or "").partition("\n\nArgs:")[0] for name, verb in verbs.items()}
        named = [tyro.conf.subcommand(name, description=text) for name, text in told.items()]
        return tyro.cli(
            cast(Any, Union[tuple(Annotated[_Verb, each] for each in named)]),  # noqa: UP007, of a tuple
            prog="lidarsynth",
            description="Generate, complete and judge LiDAR scans.",
            args=argv or ["--help"],
        )


def _no_empty_word(words: list[str]) -> None:
    """Raises ValueError for an empty word, as "$OUT" is in a script that does not set it: the path of that name is the
    current folder."""
    before = ""
    for word in words:
        name, equals, value = word.partition("=")
        if not word or (name.startswith("--") and equals and not value):
            of = name or (before if before.startswith("-") else "")
            raise ValueError(f"expected {f'a value of {of}' if of else 'a word'}, found an empty one")
        before = word


def _one_recipe(words: list[str]) -> None:
    """Raises ValueError where a recipe stands twice: the first would be lost unseen, and errors be those of the last.

    Of other options the last one counts, as in any script that goes on with "$@".
    """
    count = sum(word.partition("=")[0] == "--corrupt" for word in words)
    if count > 1:
        raise ValueError(f"expected --corrupt once, several recipes joined by +, found it {count} times")


@dataclass
class _Verb:
    """What stands for every verb in the list of all: described as functions, help takes half again as long."""


def _later(verb: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    @wraps(verb)
    def _with_arguments(*args, **kwargs):
        return partial(verb, *args, **kwargs)

    return _with_arguments


def _plain_words(verb: Callable[..., None] | None) -> list[str]:
    """The arguments of a verb that stand without an option's name, such as ROOT."""
    hints = get_type_hints(verb, include_extras=True).items() if verb else ()
    return [name.upper() for name, hint in hints if tyro.conf.Positional in _marks(hint)]


def _marks(hint: Any) -> tuple[Any, ...]:
    """What `Annotated` says of a parameter; Python 3.10 wraps it as an Optional where the default is None."""
    told = (getattr(one, "__metadata__", ()) for one in (hint, *get_args(hint)))
    return next(filter(None, told), ())


def _options(described: Any) -> dict[str, str]:
    """The options of a verb, or of a class of them, by their names and by those of the parameters; None has none."""
    options = {}
    if described is None:
        return options
    for name, hint in get_type_hints(described, include_extras=True).items():
        called = [word for part in _marks(hint) if (word := getattr(part, "name", None)) is not None]
        if called == [""]:
            options |= _options(hint.__origin__)
        elif name != "return":
            options[f"--{name.replace('_', '-')}"] = f"--{(called or [name])[-1].replace('_', '-')}"
    return options | {own: own for own in options.values()}


def _refusals(verb: Callable[..., None] | None) -> AbstractContextManager[None]:
    """While it is open, what tyro would complain of in a box is a ValueError of one line."""
    return nullcontext() if events is None else events.on_parse_error(partial(_refuse, verb))


def _refuse(verb: Callable[..., None] | None, event: events.ParseErrorEvent) -> NoReturn:
    raise ValueError(f"{event.prog}: {_said(verb, event)}") from None


def _given(message: str) -> str:
    """What was given, of the message of a parser of numbers; else the message, which is a type's own."""
    known = re.match("invalid literal|could not convert|no type matching", message)
    found = re.search("'([^']*)'", message) if known else None
    return f" {found[1]!r}" if found else f": {message}"


def _said(verb: Callable[..., None] | None, event: events.ParseErrorEvent) -> str:
    """What was expected and what was found."""
    if isinstance(event, events.MissingArgs):
        names = ", ".join(missing.arg.display_name() for missing in event.missing_arguments)
        return f"expected {names}, found {' '.join(event.unrecognized_tokens) or 'none'}"
    if isinstance(event, events.UnrecognizedArgs):
        found, plain = event.tokens[0], " ".join(_plain_words(verb))
        near = {name: own for name, own in _options(verb).items() if name[:3] == found[:3]}  # a first letter is no slip
        return f"expected {plain and f'{plain} and '}its options, found {' '.join(event.tokens)}{_meant(found, near)}"
    if isinstance(event, events.InvalidChoice):
        choices = ", ".join(choice for choice in event.choices if choice != "None")
        name = event.argument.display_name()
        return f"expected {name} of {choices}, found {event.value!r}{_meant(event.value, event.choices)}"
    if isinstance(event, events.BadValue):
        return f"expected a value of {event.argument.display_name()}, found {event.offending_value or 'none'}"
    if isinstance(event, events.InstantiationFailure):
        name = "its arguments" if event.argument is None else event.argument.display_name()
        return f"expected {name} as --help says, found{_given(event.message)}"
    return f"expected what --help says, found {type(event).__name__}"


def _meant(found: str, words: Iterable[str]) -> str:
    """The word that was probably meant, as a question; of a mapping, what it stands for."""
    near = get_close_matches(found, list(words), n=1)
    if not near:
        return ""
    return f"; was {words[near[0]] if isinstance(words, Mapping) else near[0]} meant?"
