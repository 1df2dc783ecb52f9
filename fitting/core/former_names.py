"""Modules of the inverse side that documents named, under the names that they had before 0.2."""

from oceaninv.foundation.former_names import hand_on

hand_on(
    {
        "fitting.casts": "fitting.files.cast_file",
        "fitting.charts": "fitting.images.chart_reading",
        "fitting.cli": "fitting.commands.main",
        "fitting.html": "fitting.report.web_page",
        "fitting.readers": "fitting.images.photo_csv",
        "fitting.restore": "fitting.photo.restore",
        "fitting.targets": "fitting.images.chart_targets",
        "fitting.trade": "oceaninv.fidelity.trade_off",
        "fitting.verdicts": "fitting.images.quality_checks",
    }
)
