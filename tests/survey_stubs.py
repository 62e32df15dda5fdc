"""Small inputs, configurations and cheap jobs for the tests of surveys; the tags of a page."""

from html.parser import HTMLParser

HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>'


class Tags(HTMLParser):
    """All start tags of a page with their attributes, and its text outside the style sheet."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.tags and self.tags[-1][0] != "style":
            self.words.append(data)


def inputs(folder, count=3):
    """Write small files and return a configuration with one sequence for each."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "opd.fits").write_bytes(b"a map")
    sequences = []
    for k in range(count):
        path = folder / f"star{k}_calints.fits"
        # Nobody reads them but the hash.
        path.write_bytes(bytes([k]) * 100)
        sequences.append({"files": str(path), "opd": str(folder / "opd.fits"), "size": 40})
    return {"workers": 0, "sequence": sequences}


def configuration(path, content):
    """Write a configuration of `inputs` as TOML."""
    lines = [f"workers = {content['workers']}"]
    for each in content["sequence"]:
        lines += ["[[sequence]]", *(f"{key} = {value!r}" for key, value in each.items())]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def result(target="HD 1"):
    """What a reduction says, with one candidate."""
    candidate = {
        "separation_arcsec": 0.82, "separation_error_arcsec": 0.004, "position_angle_deg": 149.9,
        "position_angle_error_deg": 0.4, "contrast": 3e-4, "contrast_error": 1e-5, "snr": 30.0,
        "false_alarm_probability": 1e-12,
    }  # fmt: skip
    limits = [{"separation_arcsec": s, "contrast": 1e-5 / s} for s in (0.5, 1.0, 1.5)]
    curve = {
        "sigmas": 5.0, "separation_arcsec": [0.4, 1.0, 1.6], "contrast": [3e-5, 1e-5, None],
    }  # fmt: skip
    return {
        "target": target, "filter": "F444W", "sentence": "One companion candidate.",
        "candidates": [candidate], "limits": limits, "threshold_snr": 5.0, "left_out": [],
        "fit_status": "MODEL_MISMATCH", "reduced_chi2": 1.3, "error_factor": 1.2, "frames": 2,
        "curve": curve,
    }  # fmt: skip


def stub(job, folder):
    """A job that takes no time."""
    (folder / "report.html").write_text("<p>report</p>", encoding="utf-8")
    recovered = {"contrast": 1.1e-5, "contrast_error": 2e-6, "snr": 6.0, "detected": True}
    return {**result(), **({"recovered": recovered} if job.injection else {})}
