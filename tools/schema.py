"""The configuration as a JSON schema, with which editors complete keys and mark mistakes.

    python -m tools.schema      writes workflow/schemas/config.schema.json

It is made from the settings' classes, which check more, such as what several keys say together, and
say it in one line. In config.yaml the line `# yaml-language-server` names it.
"""

import json
from pathlib import Path
from typing import Any

from mace_rl.base.files import write_atomically
from mace_rl.config.run import IDENTITY, RunConfig
from mace_study.config.study import Study

GOAL = Path(__file__).resolve().parent.parent / "workflow" / "schemas" / "config.schema.json"


def schema() -> dict[str, Any]:
    """That of config.yaml, and of any file that is read over it: no key has to be there."""
    run, study = RunConfig.model_json_schema(), Study.model_json_schema()
    definitions: dict[str, Any] = run["$defs"] | study.pop("$defs")
    settings = {name: part for name, part in run["properties"].items() if name not in IDENTITY}
    definitions["Settings"] = {"type": "object", "additionalProperties": False}
    definitions["Settings"]["properties"] = settings
    definitions["ShownVariant"]["properties"] |= settings
    definitions["ShownVariant"]["additionalProperties"] = False
    by_name = {"type": "string"}  # a wrapper without arguments
    definitions["WrapperConfig"] = {"anyOf": [by_name, definitions["WrapperConfig"]]}
    properties, of_settings = study["properties"], {"$ref": "#/$defs/Settings"}
    properties["training"] = of_settings
    properties["environment_settings"]["additionalProperties"] = of_settings
    study |= {"$schema": "https://json-schema.org/draft/2020-12/schema", "$defs": definitions}
    return _partial(study)


def _partial(part: Any) -> Any:
    """Without what has to be there and what is there otherwise; of a union any member will do."""
    if isinstance(part, list):
        return [_partial(item) for item in part]
    if not isinstance(part, dict):
        return part
    found = {}
    for key, value in part.items():
        if key in ("properties", "$defs"):  # by names of the configuration
            found[key] = {name: _partial(item) for name, item in value.items()}
        elif key not in ("required", "default", "discriminator", "title"):
            found["anyOf" if key == "oneOf" else key] = _partial(value)
    return found


def main() -> None:
    """Entry point."""
    GOAL.parent.mkdir(exist_ok=True)
    write_atomically(GOAL, json.dumps(schema(), indent=1) + "\n")
    print(GOAL)


if __name__ == "__main__":
    main()
