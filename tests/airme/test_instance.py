"""Instances: what the generator draws, what a file holds, and how a bad one is refused."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from marl_sched.domain import get_domain
from marl_sched.envs.airme.aircraft import FIXED_WING, HELICOPTER, AircraftType
from marl_sched.envs.airme.instance import SCALES, AirmeInstance, generate, load
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError

AIRME = get_domain("airme")
# Section 6.5.2: fixed-wing planes, helicopters, crews.
PUBLISHED_SCALES = {
    "small": ((16, 24), (8, 12), (6, 8)),
    "medium": ((32, 48), (16, 24), (12, 16)),
    "large": ((64, 96), (32, 48), (24, 32)),
}
COLUMNS = ("kind", "income", "hours", "landings", "broken")
TWO_PLANES = AirmeInstance(
    n_crews=3, kind=[0, 1], income=[12.5, 3.25], hours=[100, 7], landings=[15, 0], broken=[False, True]
)


def equal(a: AirmeInstance, b: AirmeInstance) -> bool:
    columns = all((getattr(a, name) == getattr(b, name)).all() for name in COLUMNS)
    return columns and a.n_crews == b.n_crews and a.types == b.types


class TestGenerator:
    @pytest.mark.parametrize("scale", PUBLISHED_SCALES)
    def test_sizes_are_uniform_within_the_published_bounds(self, scale: str) -> None:
        fleets = AIRME.instances(scale, 600, seed=1)
        counts = np.array([[(i.kind == 0).sum(), (i.kind == 1).sum(), i.n_crews] for i in fleets]).T
        for found, (low, high) in zip(counts, PUBLISHED_SCALES[scale], strict=True):
            assert (min(found), max(found)) == (low, high)
            assert chisquare(np.bincount(found, minlength=high + 1)[low:]).pvalue > 1e-4

    def test_hours_landings_broken_and_income_follow_the_published_laws(self) -> None:
        fleets = AIRME.instances("small", 600, seed=2)
        hours, landings, broken, kind, income = (
            np.concatenate([getattr(i, name) for i in fleets])
            for name in ("hours", "landings", "broken", "kind", "income")
        )
        assert (hours.min(), hours.max()) == (0, 120)
        assert chisquare(np.bincount(hours)).pvalue > 1e-4
        assert broken.mean() == pytest.approx(0.1, abs=0.01)
        assert (landings >= np.maximum(hours // 10 - 2, 0)).all()
        assert (landings <= hours // 5 + 2).all()
        # At 100 to 104 hours: uniform on 10..20 plus uniform on -2..2, mean 15, variance 10 + 2.
        century = landings[hours // 5 == 20]
        assert (century.min(), century.max()) == (8, 22)
        assert century.mean() == pytest.approx(15, abs=4 * (12 / len(century)) ** 0.5)
        assert century.var() == pytest.approx(12, rel=0.2)
        for k, high in ((0, 20), (1, 10)):
            assert kstest(income[kind == k], "uniform", args=(1, high - 1)).pvalue > 1e-4

    def test_instance_depends_on_seed_and_index_alone(self) -> None:
        few, many = AIRME.instances("small", 3, seed=5), AIRME.instances("small", 9, seed=5)
        assert all(map(equal, few, many))
        assert equal(many[7], generate("small", np.random.default_rng([5, 7])))

    def test_instances_differ_by_index_and_seed(self) -> None:
        identities = {i.identity for seed in (1, 2) for i in AIRME.instances("small", 50, seed=seed)}
        assert len(identities) == 100

    def test_unknown_scale_raises(self) -> None:
        with pytest.raises(UnknownNameError, match="did you mean 'medium'"):
            generate("medum", np.random.default_rng(0))

    def test_users_types_take_the_places_of_the_published_ones(self) -> None:
        drone = AircraftType(name="drone", scales=(9.0,), shapes=(3.0,), hour_norm=1.0, usage=0.9, income=(5.0, 6.0))
        instance = generate("small", np.random.default_rng(0), types=(drone, HELICOPTER))
        assert instance.types == (drone, HELICOPTER)
        assert (instance.income[instance.kind == 0] >= 5.0).all()
        with pytest.raises(InvalidOptionError, match="mix two aircraft types, got 1"):
            generate("small", np.random.default_rng(0), types=(drone,))


class TestIdentity:
    # blake2b over the text of crews and types, then the columns as little-endian words, computed once with hashlib.
    GOLDEN = 10878837389845680955

    def test_is_the_hash_of_the_content(self) -> None:
        text = (
            "(3, (AircraftType(name='fixed_wing', scales=(15.0, 12.0, 18.0, 16.0), shapes=(5.0, 5.5, 6.0, 6.5), "
            "hour_norm=20.0, usage=0.6, income=(1.0, 20.0)), AircraftType(name='helicopter', scales=(8.0, 7.0, 5.0), "
            "shapes=(7.0, 6.0, 11.0), hour_norm=15.0, usage=0.3, income=(1.0, 10.0))))"
        )
        content = text.encode() + struct.pack("<2i2d2i2i2?", 0, 1, 12.5, 3.25, 100, 7, 15, 0, False, True)
        expected = int.from_bytes(blake2b(content, digest_size=8).digest(), "little")
        assert TWO_PLANES.identity == expected == self.GOLDEN

    @pytest.mark.parametrize(
        "change",
        [
            {"n_crews": 4},
            {"kind": [0, 0]},
            {"income": [12.5, 3.3]},
            {"hours": [101, 7]},
            {"landings": [15, 1]},
            {"broken": [True, True]},
            {"types": (HELICOPTER, FIXED_WING)},
        ],
    )
    def test_changes_with_any_content(self, change: dict[str, Any]) -> None:
        same = {name: getattr(TWO_PLANES, name) for name in (*COLUMNS, "n_crews", "types")}
        assert AirmeInstance(**same).identity == TWO_PLANES.identity
        assert AirmeInstance(**{**same, **change}).identity != TWO_PLANES.identity


class TestFile:
    @pytest.mark.parametrize("scale", SCALES)
    def test_round_trip_keeps_content_and_identity(self, scale: str, tmp_path: Path) -> None:
        instance = generate(scale, np.random.default_rng(3))
        instance.save(tmp_path / "fleet.json")
        again = load(tmp_path / "fleet.json")
        assert equal(again, instance)
        assert again.identity == instance.identity

    def test_round_trip_of_a_type_given_in_integers(self, tmp_path: Path) -> None:
        glider = AircraftType(name="glider", scales=(9, 3), shapes=(2, 1), hour_norm=2, usage=1, income=(1, 2))
        instance = AirmeInstance(n_crews=1, kind=[0], income=[1], hours=[0], landings=[0], broken=[0], types=(glider,))
        instance.save(tmp_path / "fleet.json")
        assert load(tmp_path / "fleet.json").identity == instance.identity

    def test_saving_leaves_nothing_beside_the_file(self, tmp_path: Path) -> None:
        TWO_PLANES.save(tmp_path / "fleet.json")
        assert [path.name for path in tmp_path.iterdir()] == ["fleet.json"]

    @pytest.mark.parametrize(
        ("break_it", "message"),
        [
            (lambda d: d.update(schema=3), "schema: expected 1 or 2, got 3"),
            (lambda d: d.update(env="murse"), "env: expected 'airme', got 'murse'"),
            (lambda d: d.pop("n_crews"), "n_crews: expected an integer in [1, 10000]; the field is missing"),
            (lambda d: d.update(n_crews=0), "n_crews: expected an integer in [1, 10000], got 0"),
            (lambda d: d.update(n_crews=True), "n_crews: expected an integer in [1, 10000], got True"),
            (lambda d: d.update(planes=[]), "planes: expected a list of 1 to 10000 planes, got []"),
            (lambda d: d.update(types={}), "types: expected a list that is not empty, got {}"),
            (lambda d: d["planes"].__setitem__(1, 7), "planes[1]: expected an object, got 7"),
            (lambda d: d["planes"][1].pop("income"), "planes[1].income: expected a number in (0, 1e+09] (per"),
            (lambda d: d["planes"][1].update(income=-3.0), "planes[1].income: expected a number in (0, 1e+09]"),
            (lambda d: d["planes"][1].update(income=float("nan")), "expected valid JSON (NaN is none of its numbers)"),
            (lambda d: d["planes"][1].update(income=10**400), "planes[1].income: expected a number in (0, 1"),
            (lambda d: d["planes"][1].update(income=1e308), "planes[1].income: expected a number in (0, 1e+09]"),
            (lambda d: d["planes"][0].update(hours=1.5), "planes[0].hours: expected an integer in [0, 1000000], got 1"),
            (lambda d: d["planes"][0].update(hours=-1), "planes[0].hours: expected an integer in [0, 1000000], got -1"),
            (lambda d: d["planes"][0].update(hours=10**7), "planes[0].hours: expected an integer in [0, 1000000], g"),
            (lambda d: d["planes"][0].update(landings="4"), "planes[0].landings: expected an integer in [0, 1000000]"),
            (lambda d: d["planes"][0].update(broken=0), "planes[0].broken: expected true or false, got 0"),
            (lambda d: d["planes"][0].update(type="glider"), "planes[0].type: expected one of ['fixed_wing', 'heli"),
            (lambda d: d["planes"][0].update(type=["x"]), "planes[0].type: expected an aircraft type's name, got ["),
            (lambda d: d["planes"][1].update(colour=1), "planes[1].colour: expected one of type, income, hours, l"),
            (lambda d: d["types"][1].update(shape=1), "types[1].shape: expected one of name, scales, shapes"),
            (lambda d: d.update(n_crew=1), "n_crew: expected one of schema, env, n_crews, types, planes, got 'n_crew'"),
            (lambda d: d["types"].__setitem__(0, "x"), "types[0]: expected an object, got 'x'"),
            (lambda d: d["types"][0].update(name=""), "types[0].name: expected a name, got ''"),
            (lambda d: d["types"][0].update(name="helicopter"), "types: expected names that differ, got ['helicopter'"),
            (lambda d: d["types"][1].update(scales=[1, -1, 1]), "types[1].scales: expected numbers > 0, one for each"),
            (lambda d: d["types"][1].update(shapes=[1, 1]), "types[1].shapes: expected 3 numbers > 0, got [1.0, 1.0]"),
            (lambda d: d["types"][1].update(hour_norm=0), "types[1].hour_norm: expected a number > 0, got 0"),
            (lambda d: d["types"][1].update(usage=1.2), "types[1].usage: expected a probability in [0, 1], got 1.2"),
            (lambda d: d["types"][1].update(income=[2, 1]), "types[1].income: expected bounds 0 < low <= hig"),
            (lambda d: d["types"][1].update(income=[1]), "types[1].income: expected bounds 0 < low <= high <= 1e+0"),
            (lambda d: d["types"][1].update(income=[1, 1e308]), "types[1].income: expected bounds 0 < low <= high"),
        ],
    )  # fmt: skip
    def test_malformed_field_is_named_with_what_was_expected(
        self, break_it: Callable[[dict[str, Any]], object], message: str, tmp_path: Path
    ) -> None:
        path = tmp_path / "fleet.json"
        TWO_PLANES.save(path)
        data = json.loads(path.read_text())
        break_it(data)
        path.write_text(json.dumps(data))
        with pytest.raises(InvalidFileError) as caught:
            load(path)
        assert str(caught.value).startswith(f"{path}: {message}")

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"[]", "expected an object, got []"),
            (b"", "line 1 column 1: expected valid JSON"),
            (b'{"schema": 1, "env": "airme", "n_crews"', "line 1 column 40: expected valid JSON"),
            (b'{"env": "\xff"}', "byte 9: expected UTF-8 text"),
        ],
    )
    def test_file_that_is_no_instance_is_refused(self, content: bytes, message: str, tmp_path: Path) -> None:
        path = tmp_path / "fleet.json"
        path.write_bytes(content)
        with pytest.raises(InvalidFileError) as caught:
            load(path)
        assert str(caught.value).startswith(f"{path}: {message}")

    def test_missing_file_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(InvalidFileError, match=r"nowhere\.json: expected a readable file \(No such file"):
            load(tmp_path / "nowhere.json")


class TestAsPythonObject:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"n_crews": 1_000_000}, "n_crews: expected 1 to 10000, got 1000000"),
            ({"n_crews": 0}, "n_crews: expected 1 to 10000, got 0"),
            ({"kind": [0, 2]}, r"planes\[1\].kind: expected an index into 2 types, got 2"),
            ({"income": [1.0, 0.0]}, r"planes\[1\].income: expected a number in \(0, 1e\+09\]"),
            ({"income": [float("inf"), 1.0]}, r"planes\[0\].income: expected a number in"),
            ({"income": [1e308, 1e308]}, r"planes\[0\].income: expected a number in"),
            ({"hours": [-1, 0]}, r"planes\[0\].hours: expected an integer in \[0, 1000000\], got -1"),
            ({"landings": [0, -2]}, r"planes\[1\].landings: expected an integer in \[0, 1000000\], got -2"),
            ({"broken": [True]}, r"broken: expected one value per plane \(2\), got \(1,\)"),
        ],
    )
    def test_impossible_value_raises(self, change: dict[str, Any], message: str) -> None:
        good = {name: getattr(TWO_PLANES, name) for name in (*COLUMNS, "n_crews")}
        with pytest.raises(InvalidOptionError, match=message):
            AirmeInstance(**{**good, **change})

    def test_arrays_are_read_only(self) -> None:
        with pytest.raises(ValueError, match="read-only"):
            TWO_PLANES.hours[0] = 3
