"""Print what is installed in this environment as a CycloneDX bill of materials."""

import json
import sys
from importlib.metadata import distributions

_HIDDEN = {"pip", "setuptools", "wheel"}
"""Tools of the environment; the project does not need them."""

components = [
    {
        "type": "library",
        "name": each.metadata["Name"],
        "version": each.version,
        "purl": f"pkg:pypi/{each.metadata['Name'].lower().replace('_', '-')}@{each.version}",
        **(
            {"licenses": [{"license": {"name": licence}}]}
            if (licence := each.metadata.get("License-Expression") or each.metadata.get("License"))
            else {}
        ),
    }
    for each in sorted(distributions(), key=lambda each: each.metadata["Name"].lower())
    if each.metadata["Name"].lower() not in _HIDDEN
]
json.dump(
    {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1, "components": components},
    sys.stdout,
    indent=1,
)
