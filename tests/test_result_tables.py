"""Scripts of tests/acceptance and tests/benchmarks have tables; no test reads anything outside."""

import re

import pytest

from tests.paths import ROOT

ACCEPTANCE, BENCHMARKS = ROOT / "tests/acceptance", ROOT / "tests/benchmarks"


def tables(folder):
    return sorted(path.stem for path in folder.glob("*.md") if path.stem != "README")


def scripts(folder):
    return sorted(path.stem for path in folder.glob("*.py") if not path.stem.startswith("_"))


def writer(table, candidates):
    """The script whose name is that of the table, or the longest one before an underscore in it."""
    found = [name for name in candidates if table == name or table.startswith(f"{name}_")]
    return max(found, key=len, default=None)


def test_the_writer_of_a_table_is_its_longest_prefix():
    names = ["photo_rows", "pictures", "pictures_spheres"]
    assert writer("pictures_spheres", names) == "pictures_spheres"
    assert writer("photo_rows_weak", names) == "photo_rows"
    assert writer("photo_weak", names) is None
    assert writer("picturesque", names) is None


def test_every_acceptance_table_has_a_script_and_the_reverse():
    names = scripts(ACCEPTANCE)
    assert len(names) > 20
    written = {table: writer(table, names) for table in tables(ACCEPTANCE)}
    assert [table for table, script in written.items() if script is None] == []
    assert sorted(set(names) - set(written.values())) == []


def test_every_benchmark_has_a_table_and_the_reverse():
    names = scripts(BENCHMARKS)
    assert all(name.startswith("bench_") for name in names)
    assert tables(BENCHMARKS) == [name.removeprefix("bench_") for name in names]


@pytest.mark.parametrize("folder", [ACCEPTANCE, BENCHMARKS], ids=lambda folder: folder.name)
def test_a_table_says_how_to_make_it(folder):
    """By its first lines: the command that writes or prints it, which exists."""
    for table in tables(folder):
        text = (folder / f"{table}.md").read_text(encoding="utf-8")
        found = re.search(rf"tests[./]{folder.name}[./](\w+)", text)
        assert found is not None, table
        script = found.group(1)
        expected = writer(table, scripts(ACCEPTANCE)) if folder is ACCEPTANCE else f"bench_{table}"
        assert script == expected, table


def test_the_readme_lists_every_acceptance_script():
    text = (ACCEPTANCE / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `(\w+)", text, flags=re.MULTILINE)
    assert sorted(listed) == scripts(ACCEPTANCE)


def test_no_test_reads_beside_the_checkout():
    """Neither tests nor scripts name a folder outside the repository, and no test skips itself."""
    forbidden = re.compile(
        r"ROOT\.parent|parents\[3\]|import" + r"orskip|pytest\.skip|mark\.skip|\.\./sha" + "red"
    )
    found = {
        f"{path.relative_to(ROOT)}: {match.group()}"
        for path in (ROOT / "tests").rglob("*.py")
        for match in forbidden.finditer(path.read_text(encoding="utf-8"))
        if path.name != "test_result_tables.py"
    }
    assert found == set()
