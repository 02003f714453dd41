"""Each defect of `mutations.toml` can be put back into the package as it is."""

from __future__ import annotations

from pathlib import Path

from simulator.mutations import mutations

ROOT = Path(__file__).parents[2]


def test_every_mutation_fits_the_package() -> None:
    for mutation in mutations():
        for change in mutation.changes:
            text = (ROOT / "src" / "rlightning_aio" / change["file"]).read_text()
            assert text.count(change["now"]) == 1, f"{mutation.name}: change it in mutations.toml"
