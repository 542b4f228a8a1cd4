"""The settings that options of a command ask for."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from ..api.photo_reader import Settings
from ..api.scan import ONLY_DEFAULT
from ..api.values import Accuracy, CoarseToFineSettings, PaperSettings
from ..batch.localizer import Localizer
from ..cloud.cloud_settings import CloudSettings
from ..photo.photo import NOTHING_KNOWN, Photo, Prior
from ..scan_map.open_map import CachePolicy
from ..system.errors import InputError
from .command import Arguments
from .options import NONE

PRESETS: dict[str, type[Settings]] = {"default": CoarseToFineSettings, "paper": PaperSettings}


def cloud_settings_from(arguments: Arguments) -> CloudSettings:
    """Return the options of add_cloud_reading_options."""
    crs = vars(arguments).get("crs")  # not of commands without photos
    return CloudSettings.of_options(
        arguments.ignore_colors,
        scale=arguments.units,
        up=arguments.up,
        crs=None if crs == NONE else crs,
        color_range=None if arguments.color_range == "auto" else float(arguments.color_range),
        columns=tuple(arguments.columns),
    )


def cache_from(arguments: Arguments) -> CachePolicy:
    """Return where prepared maps are kept."""
    is_used = arguments.cache != Path(NONE)
    return CachePolicy(is_used, arguments.cache if is_used else None)


def localizer_from(arguments: Arguments, paths: tuple[Path, ...] = ()) -> Localizer:
    """Return what localizes photos in the scan of some files as the options ask for."""
    cloud_settings = cloud_settings_from(arguments)
    names = {f.name for f in fields(Photo)}
    photo = Photo(Path(), **{name: value for name, value in vars(arguments).items() if name in names})
    return Localizer(paths, settings_from(arguments), cloud_settings, photo, cache_from(arguments))


def settings_from(arguments: Arguments) -> Settings:
    """Return the settings that the options ask for; an option of the other preset is refused."""
    name, *words = arguments.preset
    if name not in PRESETS:
        raise InputError(f"--preset: found {name!r}, wanted {' or '.join(PRESETS)}")
    given = parse_settings(name, words)
    asked = {"gravity": arguments.gravity, "min_confidence": arguments.min_confidence}
    given |= {name: value for name, value in asked.items() if value is not None}
    accuracy = accuracy_from(arguments.accuracy)
    options = vars(arguments)
    prior = prior_from(options)
    if name == "paper":
        told = [f.name for f in fields(Prior) if getattr(prior, f.name) != getattr(NOTHING_KNOWN, f.name)]
        foreign = [option for option in told if option != "use_gps"]
        foreign += [option for option in ONLY_DEFAULT if options.get(option)]
        foreign += ["up"] if arguments.up != "auto" else []
        foreign += ["accuracy"] if accuracy else []
        if foreign:
            raise InputError(f"`{foreign[0]}`: not an option of the preset paper")
    else:
        given["prior"] = prior
        given |= {"accuracy": accuracy} if accuracy else {}
    return PRESETS[name](**given)


def accuracy_from(numbers: Sequence[float] | None) -> Accuracy | None:
    """Return the accuracy that one or two numbers ask for; None of none."""
    if numbers is None:
        return None
    if len(numbers) > len(fields(Accuracy)):
        raise InputError(f"`accuracy`: found {len(numbers)} numbers, wanted METRES or METRES DEGREES")
    return Accuracy(*numbers)


def prior_from(options: dict[str, Any]) -> Prior:
    """Return what the options say of the poses of all photos; nothing of a command without them."""
    near = options.get("near") or []
    return Prior(
        near=tuple(near[:3]) or None,
        radius=near[3] if near else None,
        height=options.get("height"),
        heading_deg=options.get("heading"),
        within=options.get("within") or (),
        use_gps=options.get("crs") != NONE,
    )


def parse_settings(preset: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings of a preset that are written as NAME=VALUE."""
    hints = {
        name: hint
        for name, hint in get_type_hints(PRESETS[preset]).items()
        if name not in ("prior", "accuracy")
    }
    given: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name not in hints:
            raise InputError(f"--preset {preset}: found {word!r}, wanted NAME=VALUE of {', '.join(hints)}")
        hint = hints[name]
        choices: dict[str, Any] = {choice: choice for choice in get_args(hint)}
        if hint is bool:
            choices = {"true": True, "false": False}
        try:
            given[name] = choices[text] if choices else hint(text)
        except (KeyError, ValueError) as error:
            wanted = f"one of {', '.join(choices)}" if choices else hint.__name__
            raise InputError(f"--preset {preset}: found {word!r}, wanted {wanted}") from error
    return given
