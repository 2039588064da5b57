"""The README's table says what the cells say."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
ROWS = [  # of the table of profit, in the README's order
    "Corrective", "Condition-based", "Model-based", "preventive-first", "airme-full",
    "preventive-first, local", "airme-local", "preventive-first, 12 h late", "airme-stale",
]  # fmt: skip


def test_scores_gains_shares_and_the_bound_are_those_of_the_page():
    results = json.loads((ROOT / "docs" / "results" / "airme.json").read_text(encoding="utf-8"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = [line.strip("| ").split(" | ") for line in text.split("| who decides")[1].split("\n\n")[0].splitlines()[2:]]
    assert len(shown) == len(ROWS)
    small = {row["label"]: row["scales"].get("small") for row in results["objectives"]["profit"]["rows"]}
    for label, (_, sees, m1, *gain) in zip(ROWS, shown, strict=True):
        found = small[label]
        assert m1 == f"{found['M1']['mean']:.3f}", label
        expected = "" if label == "Corrective" else f"{found['M2']['mean']:.1f} %"
        assert "".join(gain).strip(" |") == expected, label
        share = re.search(r"(\d+) %", sees)
        assert (share is None) == (found["visible_share"] == 1.0), label
        assert share is None or int(share[1]) == round(100 * found["visible_share"]), label
    bound = results["objectives"]["profit"]["scales"]["small"]["bound"]["M1"]["mean"]
    assert f"expects more than {bound:.3f} on these fleets" in " ".join(text.split())
