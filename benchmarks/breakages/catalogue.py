"""The breakages: one line of the package changed, and the property that is then lost.

A change is found by its text, wherever the module is; the text must be in the package exactly
once. The test files named with it are those that are run first.
"""

from __future__ import annotations

from typing import NamedTuple


class Breakage(NamedTuple):
    """A fault that tests should notice.

    Attributes
    ----------
    name : str
    lost : str
        The property that no longer holds.
    old, new : str
        Text of the package and its replacement.
    tests : str
        Test files that are run first, without "test_" and ".py", separated by spaces.
    """

    name: str
    lost: str
    old: str
    new: str
    tests: str


def _optics() -> list[Breakage]:
    return [
        Breakage(
            "fourier-sign", "the image is not mirrored in y",
            "kernel(y, pupil_y, wavelength, -1).to(dtype)",
            "kernel(y, pupil_y, wavelength, +1).to(dtype)",
            "optics propagation_poppy",
        ),
        Breakage(
            "tilt-sign", "a source is imaged where it is",
            "x_turns = -offset[..., 0:1]", "x_turns = offset[..., 0:1]", "optics",
        ),
        Breakage(
            "adjoint-conjugate", "the inverse transform is the adjoint",
            "self._rows.mH @ field", "self._rows.mT @ field", "optics lattice",
        ),
        Breakage(
            "pupil-centre", "the pupil is centred between samples",
            "return (index - (self.npix - 1) / 2) * self.spacing",
            "return (index - self.npix / 2) * self.spacing", "optics geometry",
        ),
        Breakage(
            "detector-centre", "the middle of the array is between pixels for even sides",
            "axis = (index - (samples - 1) / 2) * (scale / self.oversample)",
            "axis = (index - samples / 2) * (scale / self.oversample)", "optics",
        ),
        Breakage(
            "detector-shift", "detector_shift moves the image to positive x and y",
            "axis = axis - shift[..., k].to(self.device)",
            "axis = axis + shift[..., k].to(self.device)", "optics",
        ),
        Breakage(
            "crosstalk-kernel", "light spreads as the kernel says, not mirrored",
            "self.kernel.flip(0, 1).to(image)[None, None]",
            "self.kernel.to(image)[None, None]", "detector_effects",
        ),
        Breakage(
            "stop-rotation", "lyot_rotation is counter-clockwise",
            "torch.stack([cosine, sine]), torch.stack([-sine, cosine])",
            "torch.stack([cosine, -sine]), torch.stack([sine, cosine])", "geometry optics",
        ),
        Breakage(
            "coverage", "pixels at the edge of a polygon are covered in part",
            "index_add(0, flat, (height * (1 - inside_x))[kept])",
            "index_add(0, flat, height[kept])", "geometry instrument",
        ),
        Breakage(
            "absorption", "an imaginary OPD absorbs light",
            "torch.exp(-wavenumber * opd.imag)", "torch.exp(wavenumber * opd.imag)",
            "optics forward_model",
        ),
        Breakage(
            "noll-parity", "even Noll indices are cosines",
            "magnitude if j % 2 == 0 else -magnitude", "magnitude if j % 2 else -magnitude",
            "optics instrument",
        ),
        Breakage(
            "blur-width", "blur is a standard deviation",
            "gain = torch.exp(-2 * (math.pi", "gain = torch.exp(-1 * (math.pi", "optics",
        ),
        Breakage(
            "array-turn", "a turned array shows the turned pupil",
            "((a + b, -1), (c + d, -2))", "((a + b, -2), (c + d, -1))",
            "bridges_poppy",
        ),
    ]  # fmt: skip


def _instrument_and_wavefront() -> list[Breakage]:
    return [
        Breakage(
            "sombrero", "the masks are the square of a jinc",
            "torch.where(s < _SECOND_ZERO_OF_J1, jinc**2, 0.0)",
            "torch.where(s < _SECOND_ZERO_OF_J1, jinc, 0.0)", "instrument parity_stpsf",
        ),
        Breakage(
            "wedge-tilt", "the wedge's dispersion has the sign of the entrance pupil",
            "3: float(-(tilt(", "3: float(+(tilt(", "instrument parity_stpsf",
        ),
        Breakage(
            "mask-centre", "positions of masks count pixels from 0",
            '(float(row["x"]) - 1, float(row["y"]) - 1),', '(float(row["x"]), float(row["y"])),',
            "instrument detector_pixels",
        ),
        Breakage(
            "quadrature", "condensed wavelengths keep the integrals of polynomials",
            "nodes.tolist()), tuple((vectors[0] ** 2).tolist()))\n\n    @property",
            "nodes.tolist()), tuple(abs(vectors[0]).tolist()))\n\n    @property", "optics",
        ),
        Breakage(
            "drift-size", "random drifts grow with the hours",
            "unit.data * (9e-9 / 1e-8 * hours / 86.0)",
            "unit.data * (9e-9 / 1e-8 * 86.0 / hours)", "opd",
        ),
        Breakage(
            "sine-modes", "sums of modes are the modes that derivatives are of",
            "torch.complex(pairs[:, 0], -pairs[:, 1])",
            "torch.complex(pairs[:, 0], pairs[:, 1])", "bases",
        ),
        Breakage(
            "map-before", "the rule 'before' takes the last map before the frames",
            "before = max((each for each in maps if each[0] <= when)",
            "before = min((each for each in maps if each[0] <= when)", "opd_choice",
        ),
        Breakage(
            "map-unit", "maps are converted to metres",
            "data = raw * length.to(u.m)", "data = raw * length.to(u.um)",
            "opd",
        ),
        Breakage(
            "evidence", "scales of a prior are those of the highest evidence",
            "share = 1 - precision * variance", "share = precision * variance",
            "response refinement recovery",
        ),
        Breakage(
            "prior-weight", "the prior holds back modes that the data do not determine",
            ".add_((1 + damping) * precision)", ".add_(1e-9 + damping * precision)",
            "response refinement recovery",
        ),
    ]  # fmt: skip


def _rules_of_a_fit() -> list[Breakage]:
    """The rules of "How a fit proceeds" in docs/concepts.md, each taken away."""
    return [
        Breakage(
            "rule-alignment", "the alignment is fitted before the wavefront",
            "skips_alignment = settings.wavefront and (not settings.free or self._is_warm)",
            "skips_alignment = settings.wavefront", "refinement candidates hard/hard_fits",
        ),
        Breakage(
            "rule-companions", "what the wavefront cannot explain gets unknowns of its own",
            "return self.objective.at(*state.unknowns.with_companions(added, state.vector))",
            "return state", "detection candidates",
        ),
        Breakage(
            "rule-bad-pixels", "bad pixels that stand alone are left out",
            "            if not self._leave_out_outliers(end, self._all_modes):\n",
            "            if True:\n", "outliers",
        ),
        Breakage(
            "rule-accurate-steps", "slow steps are followed by accurate ones",
            "is_last = may_repeat and gain < self.settings.tolerance and kappa < _FAR_KAPPA",
            "is_last = False", "gradient",
        ),
        Breakage(
            "rule-new-derivatives", "derivatives of an earlier state do not end a fit",
            "if is_new or gain > sufficient:", "if is_new or gain > 0:", "gradient",
        ),
        Breakage(
            "rule-wider-prior", "a prior that is too narrow is widened",
            "        if not priors.are_improbable(ratios):\n            return settings\n",
            "        if True:\n            return settings\n", "detection",
        ),
        Breakage(
            "rule-drift", "the drift between frames takes the size of the highest evidence",
            "        if not before.drift:\n            return end, False\n",
            "        return end, False\n", "visit short_wave",
        ),
        Breakage(
            "rule-marginal-flux", "the flux of the star is marginal",
            "if not priors.determined:", "if True:", "gradient",
        ),
        Breakage(
            "step-in-light", "a long step of flux and wavefront stays in the same light",
            "change / 2 * whole", "change / 2 * 0", "gradient",
        ),
        Breakage(
            "rule-finer", "a rough fit that does not explain its data goes on",
            "settings.tolerance > _FINER_TOLERANCE and fit.status is Status.MODEL_MISMATCH",
            "False", "detection",
        ),
        Breakage(
            "rule-widen-early", "a fit that goes on widens its prior on the way",
            "if may_widen and adapted is end.settings:", "if False:", "detection",
        ),
        Breakage(
            "rule-not-yet-converged", "a step after which the priors change is not the last",
            "converged = settled and course.carried.priors is priors", "converged = settled",
            "detection",
        ),
        Breakage(
            "beyond-bar", "the image of a source is not taken behind a bar",
            "BEYOND_MASK_ARCSEC = (1.2, 1.2)", "BEYOND_MASK_ARCSEC = (1.7, 0.0)", "wide_field",
        ),
        Breakage(
            "deeper-limits", "at every separation the deeper search is used",
            "is_deeper = their_limits < limits", "is_deeper = their_limits < 0 * limits", "deeper",
        ),
    ]  # fmt: skip


def _frames_and_files() -> list[Breakage]:
    return [
        Breakage(
            "planet-angle", "position angles are counter-clockwise from +y",
            "math.degrees(math.atan2(-x, y))", "math.degrees(math.atan2(x, y))", "simulation",
        ),
        Breakage(
            "roll-sign", "the sky turns on the detector against the telescope's roll",
            "return half_circle(other.position_angle - self.position_angle)",
            "return half_circle(self.position_angle - other.position_angle)", "sequence",
        ),
        Breakage(
            "header-roll", "the position angle of +y follows from ROLL_REF and V3I_YANG",
            'turned = roll - angle * (-1.0 if parity is None else parity)',
            'turned = roll + angle * (-1.0 if parity is None else parity)',
            "observation admission",
        ),
        Breakage(
            "saturated", "saturated pixels are left out",
            "BAD_PIXEL_BITS = 1 | 2 | 512 | 1024", "BAD_PIXEL_BITS = 1 | 512 | 1024",
            "observation backend_jwst",
        ),
        Breakage(
            "fits-pixels", "FITS counts pixels from 1",
            "else np.array(star) - 1,", "else np.array(star),", "observation",
        ),
        Breakage(
            "dither", "dithers off the mask are no dithers behind it",
            'if 0 < np.hypot(x, y) < BEHIND_THE_MASK else None',
            'if 0 < np.hypot(x, y) else None',
            "sequence",
        ),
        Breakage(
            "read-noise", "simulated errors include the read noise",
            "error = np.sqrt(np.maximum(counts, 0.0) + scene.read_noise**2)",
            "error = np.sqrt(np.maximum(counts, 1.0))", "simulation",
        ),
        Breakage(
            "far-noise", "the variance of the background is corrected, not its root",
            "(ratio**2 - 1) * floor**2", "(ratio - 1) * floor**2", "noise",
        ),
        Breakage(
            "unaligned", "shifts of aligned frames are undone, not doubled",
            "error[part].astype(float), (pixels - net)[part]",
            "error[part].astype(float), (net - pixels)[part]",
            "detector_pixels",
        ),
        Breakage(
            "combined", "frames are averaged with inverse variances",
            "weight = 1 / np.median(variance[usable])", "weight = np.median(variance[usable])",
            "observation noise",
        ),
        Breakage(
            "other-mask", "of several set-ups that of most frames is kept",
            'majority = max(counts, key=preference)',
            'majority = min(counts, key=preference)',
            "sequence admission",
        ),
        Breakage(
            "star-epochs", "coordinates of one star are compared at one epoch",
            "years = year - np.array(self.epochs or (_OLDEST_COORDINATES_YEAR, year))",
            "years = 0 * np.array(self.epochs or (_OLDEST_COORDINATES_YEAR, year))", "admission",
        ),
        Breakage(
            "few-pixels", "frames without valid pixels about the star are left out",
            "if share >= _VALID_PIXELS_SHARE:", "if share >= 0:", "admission",
        ),
        Breakage(
            "asn-roles", "associations say which frames are the target's",
            "return known.pop() if len(known) == 1 else None", "return None", "associations",
        ),
        Breakage(
            "wcs", "east is left of north in the WCS of products",
            "steps = np.array([[-cosine, sine], [sine, cosine]]) @ steps / 3600",
            "steps = np.array([[cosine, sine], [-sine, cosine]]) @ steps / 3600",
            "sky detection",
        ),
        Breakage(
            "atomic", "a product is there whole or not at all",
            "        yield temporary\n        _move(temporary, path)", "        yield path",
            "files_units",
        ),
        Breakage(
            "checksum", "files whose data changed are refused",
            "if not hdu.verify_datasum():", "if hdu.verify_datasum() is None:",
            "hard/hard_files files_units",
        ),
        Breakage(
            "masked", "masked values do not enter as numbers",
            "values[mask] = np.nan", "values[mask] = 0.0", "files_units containers",
        ),
    ]  # fmt: skip


def _fits() -> list[Breakage]:
    return [
        Breakage(
            "template-roll", "planets turn with the sky from frame to frame",
            "torch.from_numpy(rotation_matrix(self.rolls[k])).T",
            "torch.from_numpy(rotation_matrix(self.rolls[k]))",
            "detection recovery",
        ),
        Breakage(
            "absorbed", "errors include the uncertainty of the star",
            "TemplateProducts(numerator, photon - absorbed, photon)",
            "TemplateProducts(numerator, photon, photon)", "linear_model detection",
        ),
        Breakage(
            "mismatch", "a fit that does not explain its data says so",
            'return best, Status.CONVERGED if explained else Status.MODEL_MISMATCH',
            'return best, Status.CONVERGED',
            "refinement",
        ),
        Breakage(
            "outliers", "hot pixels are left out, planets are not",
            "> _OUTLIER_CHI2_RATIO * _explained(model.weigh(sources)).max()",
            "< _OUTLIER_CHI2_RATIO * _explained(model.weigh(sources)).max()",
            "outliers",
        ),
        Breakage(
            "spectrum-errors", "a column of errors is no spectrum",
            "and each.ndim == 1 and not _is_error(each)", "and each.ndim == 1", "spectrum_files",
        ),
        Breakage(
            "no-map", "without a map the star's flux is uncertain by 40 %",
            "return _FLUX_ERROR_FLAT_START", "return _FLUX_ERROR",
            "star_flux",
        ),
        Breakage(
            "pattern-place", "the pattern is matched on the detector's pixels",
            "x, y = np.subtract(self.first_pixel, observation.first_pixel)",
            "x, y = np.subtract(observation.first_pixel, self.first_pixel)", "detector_pattern",
        ),
        Breakage(
            "own-pattern", "the target's own frames are not in its pattern",
            "            and not shows_star(pattern, observation)\n", "",
            "learn",
        ),
        Breakage(
            "other-sources", "the light of other sources is left in the maps of an epoch",
            "self.residuals[name].without(light)", "self.residuals[name]",
            "combined_search",
        ),
        Breakage(
            "place-of-significance", "a source is where it is most significant",
            "lambda place: family.snr(self.stack(search, place, move, maps), spectrum),",
            "lambda place: float(family.statistic(self.stack(search, place, move, maps))),",
            "combined_search",
        ),
        Breakage(
            "pattern-size", "the size of a pattern is 1 where frames show it",
            "return 1 + float(products.numerator) / information",
            "return float(products.numerator) / information", "detector_pattern sequence",
        ),
    ]  # fmt: skip


def _detection() -> list[Breakage]:
    return [
        Breakage(
            "sky-mirror", "east is left of north in tables",
            "np.diag([-1.0, 1.0]) @ rotation_matrix(degrees)",
            "np.diag([1.0, 1.0]) @ rotation_matrix(degrees)", "sky plotting",
        ),
        Breakage(
            "small-sample", "limits near the star have the small-sample correction",
            "return student_snr(sigmas, freedom)",
            "return np.asarray(sigmas + 0 * freedom)", "error_factor detection",
        ),
        Breakage(
            "inner", "no candidate is inside the smallest separation",
            "if separation_of(more.offsets.numpy())[-1] < self.inner:",
            "if len(more) > 10:", "detection",
        ),
        Breakage(
            "inflation", "errors grow with the square root of chi-squared",
            "return math.sqrt(max(1.0, fit.reduced_chi2 * share))",
            "return max(1.0, fit.reduced_chi2 * share)",
            "detection error_factor",
        ),
        Breakage(
            "flux-error", "errors of contrasts include that of the star's flux",
            "torch.hypot(errors[0], torch.full_like(errors[0], untied))", "errors[0]",
            "detection star_flux",
        ),
        Breakage(
            "injected-roll", "injected planets turn with the sky",
            "x, y = star + planet.rotated(roll).offset",
            "x, y = star + planet.rotated(-roll).offset", "recovery",
        ),
    ]  # fmt: skip


def _around() -> list[Breakage]:
    return [
        Breakage(
            "unregister", "unregister restores pyKLIP's code",
            "        self._set(*self._saved)\n", "", "backend_contract backend",
        ),
        Breakage(
            "injected-in-dataset", "companions added to a dataset reach the fit",
            "data[i] += np.nan_to_num(align_and_scale(added, **shift))",
            "np.nan_to_num(align_and_scale(added, **shift))", "backend_jwst",
        ),
        Breakage(
            "pointings", "only frames of one orientation are averaged",
            "(apart <= _SAME_STAR_PIXELS) & (turned <= _SAME_ROLL_DEG)",
            "(apart <= _SAME_STAR_PIXELS)",
            "backend backend_refine",
        ),
        Breakage(
            "library-frames", "frames marked as references are not the target's",
            'return _flag(header, "IS_PSF")', 'return _flag(header, "IS_PSFS")',
            "sequence admission backend_references",
        ),
        Breakage(
            "tried-again", "failed jobs of a survey are tried again",
            'return self.records.get(job.key, {}).get("status") == "finished"',
            "return job.key in self.records", "survey",
        ),
        Breakage(
            "job-content", "a survey notices frames whose content changed",
            '"frames": sorted(inputs[str(path)] for path in frames)',
            '"frames": sorted(map(str, files))', "survey",
        ),
        Breakage(
            "half-a-job", "a job without all of its products is not finished",
            'whole = sizes == record["products"]', 'whole = bool(sizes)', "survey",
        ),
    ]  # fmt: skip


BREAKAGES: tuple[Breakage, ...] = (
    *_optics(), *_instrument_and_wavefront(), *_rules_of_a_fit(), *_frames_and_files(), *_fits(),
    *_detection(), *_around(),
)  # fmt: skip
