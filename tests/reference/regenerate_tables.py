"""Write the tables of oceaninv/data from the collection of published numbers.

    python tests/reference/regenerate_tables.py FOLDER [--check]

FOLDER holds the published numbers, one csv a publication, and dgk_chart_reflectances.csv.  Writes
into oceaninv/data, and the digests of what it wrote into tests/reference/table_digests.csv.  With
`--check` it writes nothing, compares with the committed tables and ends with status 1 where a
header or a number differs.  Not needed at run time: the tables are part of the package.
"""

import argparse
import csv
import hashlib
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
DATA = ROOT / "oceaninv" / "data"
DIGESTS = Path(__file__).with_name("table_digests.csv")

TYPES = ("I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C")
FLAGS = {"Kd0": 1, "Kd": 2, "KdH": 4, "a": 8, "b": 16}
# Published with each channel scaled to 1, so that the balance between channels is lost.
UNBALANCED = ("ARRI D21", "Nikon D5100")


def read(source, name):
    """Rows of a source table as dictionaries of strings."""
    with open(source / f"{name}.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def number(value, digits=12):
    """Shortest text of a number; blank stays blank."""
    return "" if value == "" else f"{float(value):.{digits}g}"


def write(folder, name, header, columns, digits=12):
    """One table: five comment lines, names, numbers."""
    lines = [f"# {key}: {header[key]}" for key in ("title", "citation", "units", "range", "note")]
    lines.append(",".join(columns))
    for row in zip(*columns.values(), strict=True):
        lines.append(",".join(number(cell, digits) for cell in row))
    (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def pick(rows, **columns):
    """Columns renamed: ours=theirs, or ours=(theirs, factor)."""
    table = {}
    for ours, theirs in columns.items():
        theirs, factor = theirs if isinstance(theirs, tuple) else (theirs, 1.0)
        cells = [row[theirs] for row in rows]
        table[ours] = [cell if cell == "" else float(cell) * factor for cell in cells]
    return table


def between(rows, low, high):
    return [row for row in rows if low <= float(row["wavelength_nm"]) <= high]


def pure_water(source, folder):
    write(
        folder,
        "IOCCG2018",
        {
            "title": "Absorption of pure water, consensus table",
            "citation": "Neeley & Mannino (editors), 2018, IOCCG Ocean Optics and Biogeochemistry"
            " Protocols, volume 1.0, Absorption coefficient, table 1.1, doi:10.25607/OBP-119;"
            " after Jonasz & Fournier 2007, Morel et al. 2007, Pope & Fry 1997, Kou et al. 1993",
            "units": "wavelength=nm, a=1/m, a_sigma=1/m, a_temperature=1/m/degC, a_salinity=1/m",
            "range": "300-800 nm",
            "note": "a for fresh water at 22 degC, the temperature of both the Pope & Fry (420-725"
            " nm) and the Kou (730-800 nm) measurements; a_temperature and a_salinity are slopes"
            " per degC and per unit of practical salinity; a_salinity is not given below 400 nm",
        },
        pick(
            between(read(source, "aw_ioccg_2018"), 300, 800),
            wavelength="wavelength_nm",
            a="a_w_per_m",
            a_sigma="a_w_unc_per_m",
            a_temperature=("dadT_1e-4_per_m_per_degC", 1e-4),
            a_salinity=("dadS_1e-4_per_m_per_psu", 1e-4),
        ),
    )
    write(
        folder,
        "PopeFry1997",
        {
            "title": "Absorption of pure water, integrating cavity",
            "citation": "Pope & Fry, 1997, Applied Optics 36:8710-8723, table 3,"
            " doi:10.1364/AO.36.008710",
            "units": "wavelength=nm, a=1/m",
            "range": "380-727.5 nm",
            "note": "fresh water at 22 degC; printed in 1/cm",
        },
        pick(read(source, "aw_pope_fry_1997"), wavelength="wavelength_nm", a="a_w_per_m"),
    )
    write(
        folder,
        "SmithBaker1981",
        {
            "title": "Absorption of the clearest natural waters",
            "citation": "Smith & Baker, 1981, Applied Optics 20:177-184, table 1,"
            " doi:10.1364/AO.20.000177",
            "units": "wavelength=nm, a=1/m",
            "range": "200-800 nm",
            "note": "an upper bound for pure water below about 420 nm; no temperature or salinity"
            " is stated",
        },
        pick(read(source, "aw_smith_baker_1981"), wavelength="wavelength_nm", a="a_w_per_m"),
    )
    write(
        folder,
        "WOPPv3",
        {
            "title": "Absorption of pure water, Water Optical Properties Processor version 3",
            "citation": "Roettgers et al., 2016, WOPP version 3; slopes Roettgers et al. 2014,"
            " Optics Express 22:25093, doi:10.1364/OE.22.025093; 300-510 nm Mason et al. 2016,"
            " Applied Optics 55:7163, doi:10.1364/AO.55.007163",
            "units": "wavelength=nm, a=1/m, a_sigma=1/m, a_temperature=1/m/degC, a_salinity=1/m",
            "range": "300-800 nm",
            "note": "a for fresh water at 20 degC; a_temperature and a_salinity are slopes per degC"
            " and per unit of practical salinity",
        },
        pick(
            between(read(source, "aw_wopp_v3_300_1100"), 300, 800),
            wavelength="wavelength_nm",
            a="a_w_per_m_20C_0psu",
            a_sigma="sigma_a",
            a_temperature="psiT_per_m_per_degC",
            a_salinity="psiS_per_m_per_psu",
        ),
    )


def constituents(source, folder):
    write(
        folder,
        "Bricaud1995",
        {
            "title": "Chlorophyll-specific absorption of phytoplankton",
            "citation": "Bricaud, Babin, Morel & Claustre, 1995, Journal of Geophysical Research"
            " 100:13321-13332, table 2, doi:10.1029/95JC00463",
            "units": "wavelength=nm, A=m2/mg, E=1",
            "range": "400-700 nm",
            "note": "a_ph = A C^(1-E) in 1/m, C chlorophyll a in mg/m3, 0.02-25 mg/m3",
        },
        pick(read(source, "aph_bricaud_1995"), wavelength="wavelength_nm", A="A", E="E"),
    )
    write(
        folder,
        "Bricaud1998",
        {
            "title": "Absorption of particles and of phytoplankton against chlorophyll",
            "citation": "Bricaud, Morel, Babin, Allali & Claustre, 1998, Journal of Geophysical"
            " Research 103:31033-31044, doi:10.1029/98JC02712",
            "units": "wavelength=nm, A_*=(1/m)(mg/m3)^-E, E_*=1",
            "range": "400-700 nm",
            "note": "a_p = A_p C^E_p for all particles, a_phi = A_phi C^E_phi for phytoplankton,"
            " in 1/m; C chlorophyll a with divinyl and pheopigments in mg/m3",
        },
        pick(
            read(source, "aph_bricaud_1998"),
            wavelength="wavelength_nm",
            A_p="A_p",
            E_p="E_p",
            A_phi="A_phi",
            E_phi="E_phi",
        ),
    )
    # Tables 1 and 2 of the paper, eight wavelengths each; water is printed in 1/cm.
    water = (0.00022, 0.000145, 0.000257, 0.000638, 0.00289, 0.0043, 0.01169, 0.0236)
    write(
        folder,
        "Gutierrez2008",
        {
            "title": "Coefficients of water constituents as printed for underwater rendering",
            "citation": "Gutierrez, Seron, Munoz & Anson, 2008, Computer Graphics Forum"
            " 27(2):547-556, tables 1 and 2; after Smith & Baker 1981, Sathyendranath et al. 1987,"
            " Stramski et al. 2001",
            "units": "wavelength=nm, a_phytoplankton=m2/mg, *=1/m",
            "range": "380-780 nm",
            "note": "eight points: interpolated water absorption is up to 36 % high at 570-580 nm;"
            " a_phytoplankton is per mg/m3 of chlorophyll; a_water is printed in 1/cm",
        },
        {
            "wavelength": (380, 440, 500, 550, 610, 670, 720, 780),
            "a_water": [100 * value for value in water],
            "a_phytoplankton": (0.025, 0.035, 0.02, 0.01, 0.007, 0.015, 0.001, 0.0001),
            "b_detritus": (0.045, 0.0375, 0.0325, 0.03, 0.0285, 0.0275, 0.027, 0.027),
            "b_minerals": (0.0675, 0.0525, 0.05, 0.045, 0.04, 0.036, 0.034, 0.032),
        },
    )
    write(
        folder,
        "Petzold1972",
        {
            "title": "Average-particle phase function of San Diego Harbor",
            "citation": "Petzold, 1972, Scripps Institution of Oceanography report 72-78; mean of"
            " three stations with water removed after Mobley, 1994, Light and Water, table 3.10",
            "units": "angle=deg, phase_function=1/sr",
            "range": "0.1-180 deg",
            "note": "integrates to 1 over the sphere when the part below 0.1 deg (5.2 %) follows"
            " angle^-1.3467; mean cosine 0.924, backscattered fraction 0.0183; measured in green"
            " light",
        },
        pick(
            read(source, "petzold_average_particle_phase_function"),
            angle="angle_deg",
            phase_function="phase_function_per_sr",
        ),
        digits=8,
    )


def water_types(source, folder):
    write(
        folder,
        "MorelMaritorena2001",
        {
            "title": "Diffuse attenuation of open-ocean (case 1) waters against chlorophyll",
            "citation": "Morel & Maritorena, 2001, Journal of Geophysical Research 106:7163-7180,"
            " table 2, doi:10.1029/2000JC000319",
            "units": "wavelength=nm, Kw=1/m, chi=(1/m)(mg/m3)^-e, e=1",
            "range": "350-700 nm",
            "note": "Kd = Kw + chi C^e in 1/m, mean over the upper layer; C chlorophyll in mg/m3",
        },
        pick(
            read(source, "kd_morel_maritorena_2001"),
            wavelength="wavelength_nm",
            Kw="K_w_per_m",
            chi="chi",
            e="e",
        ),
    )
    write(
        folder,
        "Jerlov1976",
        {
            "title": "Downward diffuse attenuation of the Jerlov water types",
            "citation": "Jerlov, 1976, Marine Optics (Elsevier), table XXVII",
            "units": "wavelength=nm, *=1/m",
            "range": "310-700 nm",
            "note": "mean Kd from 0 to 10 m; 7C and 9C have no value at 310 nm",
        },
        pick(
            read(source, "jerlov_kd_1976_table27"),
            wavelength="wavelength_nm",
            **{kind: kind for kind in TYPES},
        ),
    )
    rows = read(source, "jerlov_iop_solonenko_mobley_2015")
    for row in rows:
        row["flag"] = sum(FLAGS[flag] for flag in row["flagged"].split("|") if flag)
    columns = by_type(rows, TYPES, ("a", "b", "Kd0", "Kd", "KdH", "flag"))
    write(
        folder,
        "SolonenkoMobley2015",
        {
            "title": "Inherent optical properties fitted to the Jerlov water types",
            "citation": "Solonenko & Mobley, 2015, Applied Optics 54:5392-5401,"
            " doi:10.1364/AO.54.005392",
            "units": "wavelength=nm, flag_*=bits, *=1/m",
            "range": "300-700 nm",
            "note": "a, b total absorption and scattering; Kd0 the attenuation aimed at, Kd the"
            " authors' fit, KdH their radiative-transfer check; flag adds up the numbers of the row"
            " that a later compilation marks as doubtful: 1 Kd0 + 2 Kd + 4 KdH + 8 a + 16 b; b of"
            " type I lies below that of pure sea water up to 550 nm; no a for 3C from 675 nm and"
            " 5C from 600 nm",
        },
        columns,
    )
    types = ("IB", "II", "III", "1C", "3C", "5C")
    write(
        folder,
        "WilliamsonHollins2022",
        {
            "title": "Measured inherent optical properties of the Jerlov water types IB to 5C",
            "citation": "Williamson & Hollins, 2022, Applied Optics 61:9951-9961,"
            " doi:10.1364/AO.470464, data doi:10.6084/m9.figshare.20290782; Crown copyright (2022)"
            " Dstl, Open Government Licence v3.0",
            "units": "wavelength=nm, *=1/m",
            "range": "300-800 nm",
            "note": "a, b total absorption and scattering; measured 412-715 nm, the authors' model"
            " outside; contains public sector information licensed under the Open Government"
            " Licence v3.0",
        },
        by_type(read(source, "jerlov_iop_williamson_hollins_2022"), types, ("a", "b")),
    )


def by_type(rows, types, quantities):
    """Long rows to one column for each quantity and type."""
    first = [row for row in rows if row["water_type"] == types[0]]
    table = {"wavelength": [row["wavelength_nm"] for row in first]}
    for kind in types:
        block = [row for row in rows if row["water_type"] == kind]
        assert [row["wavelength_nm"] for row in block] == table["wavelength"]
        table |= {f"{name}_{kind}": [row[name] for row in block] for name in quantities}
    return table


def cameras(source, folder):
    spectra = {}
    rows = read(source, "camera_ssf_rawtoaces_52")
    for row in rows:
        spectra.setdefault(row["camera"], []).append([float(row[c]) for c in "RGB"])
    grid = np.unique([float(row["wavelength_nm"]) for row in rows])
    spectra = {name: np.array(block) for name, block in spectra.items()}
    spectra = {name: block / block[:, 1].max() for name, block in spectra.items()}
    origin = (
        "rawtoaces-data, Academy Software Foundation and A.M.P.A.S., Apache License 2.0 (see"
        " NOTICE.md)"
    )
    common = {"units": "wavelength=nm, *=1", "range": "380-780 nm"}
    columns = {"wavelength": grid}
    for name in sorted(spectra):
        columns |= {f"{name} {c}": spectra[name][:, i] for i, c in enumerate("RGB")}
    write(
        folder,
        "cameras",
        common
        | {
            "title": "Spectral sensitivities of cameras",
            "citation": origin,
            "note": "relative response to spectral radiance; the green maximum of each camera is 1;"
            f" each channel of {' and '.join(UNBALANCED)} was published scaled to 1, so that the"
            " balance between their channels is unknown",
        },
        columns,
        digits=6,
    )
    balanced = [name for name in spectra if name not in UNBALANCED]
    data = np.array([spectra[name].T.ravel() for name in balanced])
    mean = data.mean(axis=0)
    _, singular, axes = np.linalg.svd(data - mean, full_matrices=False)
    axes = axes * np.sign(axes.sum(axis=1))[:, None]
    sd = singular / np.sqrt(len(data) - 1)
    share = 100 * np.cumsum(sd**2) / np.sum(sd**2)
    columns = {"wavelength": grid}
    parts = {"mean": mean} | {f"component{k + 1}": sd[k] * axes[k] for k in range(3)}
    for part, values in parts.items():
        columns |= {f"{part} {c}": values.reshape(3, -1)[i] for i, c in enumerate("RGB")}
    write(
        folder,
        "generic_camera",
        common
        | {
            "title": "Mean spectral sensitivity of cameras and its three principal components",
            "citation": f"own principal component analysis of {len(balanced)} cameras of {origin}",
            "note": "each camera was first scaled to a green maximum of 1; the components are unit"
            " vectors over all channels and wavelengths times the standard deviation of their"
            f" scores, {', '.join(f'{value:.5g}' for value in sd[:3])}; they hold"
            f" {', '.join(f'{value:.3g}' for value in share[:3])} % of the variance cumulatively;"
            f" {' and '.join(UNBALANCED)} are left out, for each of their channels was published"
            " scaled to 1",
        },
        columns,
        digits=6,
    )


def inelastic(source, folder):
    """Raman shift of water and fluorescence of CDOM."""
    text = (source / "fluorescence_raman_parameters.json").read_text(encoding="utf-8")
    parameters = json.loads(text)
    cdom = parameters["cdom_fluorescence_hawes1992_FA7"]
    write(
        folder,
        "Hawes1992",
        {
            "title": "Fluorescence of coloured dissolved organic matter, sample FA7",
            "citation": "Hawes, 1992, Quantum fluorescence efficiencies of marine fulvic and humic"
            " acids, M.S. thesis, University of South Florida; fulvic acid of the West Florida"
            " shelf, as tabulated in Mobley, 1994, Light and Water, section 5.15",
            "units": "wavelength=nm, A0=1/nm",
            "range": "310-490 nm",
            "note": "A0 by wavelength of excitation w; photons per photon absorbed and nm of"
            " emission: A0 exp(-[(1/v - A1/w - B1)/(0.6 (A2/w + B2))]^2) at emission v > w,"
            " A1 = 0.470, A2 = 0.407, B1 = 8.077e-4 1/nm, B2 = -4.57e-4 1/nm; another"
            " transcription has 5.81e-5 at 310 and 9.24e-5 at 490 nm",
        },
        {"wavelength": cdom["excitation_nm"], "A0": cdom["A0_per_nm"]},
    )
    raman = parameters["raman_water"]["redistribution"]
    write(
        folder,
        "Walrafen1967",
        {
            "title": "Raman shift of liquid water, four Gaussian components",
            "citation": "Walrafen, 1967, Journal of Chemical Physics 47:114-126, at 25 degC, as"
            " used by Haltrin & Kattawar, 1993, Applied Optics 32:5356-5367",
            "units": "shift=1/cm, weight=1, width=1/cm",
            "range": "3250-3625 1/cm",
            "note": "shift and full width at half maximum of each component; weights as printed,"
            " their sum is 1",
        },
        {"shift": raman["kappa_cm-1"], "weight": raman["A"], "width": raman["dkappa_fwhm_cm-1"]},
    )


def charts(source, folder):
    """Reflectances of a colour chart."""
    path = source / "dgk_chart_reflectances.csv"
    if not path.exists():
        path = source.parent / "photos" / path.name
    with open(path, encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {"wavelength": [row["wavelength"] for row in rows]}
    for i in range(1, 19):
        columns[str(i)] = [round(float(row[f"Patch{i}"]), 4) for row in rows]
    write(
        folder,
        "DGK18",
        {
            "title": "Reflectances of the 18 patches of a DGK colour chart",
            "citation": "data of a course on underwater colorimetry, without author, year or"
            " licence; retrieved 2026",
            "units": "wavelength=nm, *=1",
            "range": "400-700 nm",
            "note": "patches in reading order, six greys from white to black first; its scale is "
            "uncertain: greys are darker than usual, and nothing is to be trusted below 430"
            " nm; rounded to 4 decimals",
        },
        columns,
    )


def digest(path):
    """SHA-256 of a text file, the same whatever ends its lines."""
    return hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()


def differences(fresh, committed):
    """One sentence for each table that is missing, new or different."""
    names = (
        {path.name for path in fresh.glob("*.csv")},
        {path.name for path in committed.glob("*.csv")},
    )
    found = [f"{name}: only remade" for name in sorted(names[0] - names[1])]
    found += [f"{name}: only committed" for name in sorted(names[1] - names[0])]
    for name in sorted(names[0] & names[1]):
        new, old = (
            (at / name).read_text(encoding="utf-8").splitlines() for at in (fresh, committed)
        )
        if new[:6] != old[:6]:
            found.append(f"{name}: the header differs")
            continue
        numbers = [np.genfromtxt(lines[6:], delimiter=",") for lines in (new, old)]
        # Principal components differ in the last printed digit between linear algebra libraries.
        if numbers[0].shape != numbers[1].shape or not np.allclose(
            *numbers, rtol=2e-5, atol=1e-9, equal_nan=True
        ):
            found.append(f"{name}: numbers differ")
    return found


def remake(source, folder):
    for chapter in (pure_water, constituents, inelastic, water_types, cameras, charts):
        chapter(source, folder)


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of the published numbers")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    asked = parser.parse_args(arguments)
    if not (asked.folder / "aw_pope_fry_1997.csv").exists():
        parser.error(f"{asked.folder} lacks aw_pope_fry_1997.csv: name the folder of these tables.")
    if asked.check:
        with tempfile.TemporaryDirectory() as fresh:
            remake(asked.folder, Path(fresh))
            found = differences(Path(fresh), DATA)
        print("\n".join(found) or "All committed tables are those that were remade.")
        return bool(found)
    remake(asked.folder, DATA)
    rows = [f"{path.name},{digest(path)}" for path in sorted(DATA.glob("*.csv"))]
    DIGESTS.write_text("\n".join(["table,sha256", *rows]) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
