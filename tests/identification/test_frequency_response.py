"""Measured frequency responses are read back from the ways in which instruments write them."""

import numpy as np
import pytest
import scipy.signal

from jaxilc.identification.frequency_response import is_frequency_response, read_frequency_response

F = np.array([1.0, 2.5, 40.0])
G = scipy.signal.TransferFunction([2.0], [0.01, 1.0]).freqresp(2 * np.pi * F)[1]


def written(path, header, *columns, separator=","):
    rows = [separator.join(map(str, row)) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


WAYS = {
    "re,im": ("f [Hz],re,im", F, G.real, G.imag),
    "rad/s": ("w (rad/s),Real,Imag", 2 * np.pi * F, G.real, G.imag),
    "abs,deg": ("freq_kHz,magnitude [mm/V],phase [deg]", F / 1e3, abs(G), np.angle(G, deg=True)),
    "dB,rad": ("Frequency (Hz),mag_dB,phase_rad", F, 20 * np.log10(abs(G)), np.angle(G)),
    "units below": ("f,mag,phase\nHz,dB,°", F, 20 * np.log10(abs(G)), np.angle(G, deg=True)),
    "complex": ("f [Hz],G", F, G),
    "complex, and half of others": ("f [Hz],G,re,gain [abs]", F, G, G.real, abs(G)),
    "complex, i": ("f [Hz],G", F, [f"{g.real} {g.imag:+}i" for g in G]),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_gives_the_same_response(tmp_path, way):
    path = written(tmp_path / "frf.csv", *WAYS[way])
    assert is_frequency_response(path)
    found = read_frequency_response(path)
    np.testing.assert_allclose(found.frequencies, F, rtol=1e-12)
    np.testing.assert_allclose(found.response, G, rtol=1e-12)
    assert not found.std.any()


def test_decimal_commas_comments_and_the_line_at_zero(tmp_path):
    path = tmp_path / "frf.txt"
    path.write_text("% analyser 7\nf [Hz];re;im\n0;9;0\n1,5;0,25;-1\n2;1e-1;,5\n")
    found = read_frequency_response(path)
    np.testing.assert_array_equal(found.frequencies, [1.5, 2.0])
    np.testing.assert_array_equal(found.response, [0.25 - 1j, 0.1 + 0.5j])


def test_std_variance_and_coherence(tmp_path):
    def std(heading, values, averages=None):
        header = f"f [Hz],re,im,{heading}"
        path = written(tmp_path / "frf.csv", header, F, G.real, G.imag, values)
        return read_frequency_response(path, averages=averages).std

    np.testing.assert_allclose(std("std", [1, 2, 3]), [1, 2, 3])
    np.testing.assert_allclose(std("Variance", [1, 4, 9]), [1, 2, 3])
    c = np.array([0.5, 0.9, 1.0])
    expected = abs(G) * np.sqrt((1 - c) / (9 * c))
    np.testing.assert_allclose(std("coherence", c, 10), expected, rtol=1e-12)
    np.testing.assert_allclose(std("Coherence [10 averages]", c), expected, rtol=1e-12)
    np.testing.assert_allclose(std("coherence", c), std("coherence", c, 2), rtol=1e-12)
    with pytest.raises(ValueError, match=r"averages = 9 is not that of the heading 'coh \(10 av"):
        std("coh (10 averages)", c, 9)
    with pytest.raises(ValueError, match=r"line 4: coh = '0' is outside \(0, 1\]"):
        std("coh", ["0.5", "1", "0"], 10)
    with pytest.raises(ValueError, match="averages = 1 is outside"):
        std("coherence", c, 1)
    with pytest.raises(ValueError, match=r"'std \[dB\]' is in db"):
        std("std [dB]", [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("f [Hz],mag [abs],phase\n1,2,3\n", "'phase' has no unit; write one of deg"),
        ("f [Hz],mag,phase [deg]\n1,2,3\n", "'mag' does not say what it is; write `magnitude"),
        ("f,re,im\n1,2,3\n", r"'f' has no unit; write one of hz, khz, rad/s"),
        ("f [rpm],re,im\n1,2,3\n", "'f .rpm.' has the unit 'rpm'"),
        ("f [Hz],re\n1,2\n", "has re but no im"),
        ("f [Hz],y\n1,2\n", "has no response"),
        ("t,re,im\n1,2,3\n", "has no frequency"),
        ("f [Hz],w [rad/s],re,im\n", "are both a frequency"),
        ("f [Hz],re,im\n1,2,3\n", "has 1 lines above 0 Hz"),
        ("f [Hz],re,im\n1,2,3\n1,2,3\n", "line 3: f .Hz. = '1' is not above the line before; sort"),
        ("f [Hz],re,im\n-1,2,3\n1,2,3\n", "line 2: f .Hz. = '-1' is a negative frequency"),
        ("f [Hz],re,im\n1,nan,3\n", "line 2: re = 'nan' is not a finite number"),
        ("f [Hz],re,im\n1,2\n", "line 2: im = '' is not a finite number"),
        ("f [Hz],G\n1,2+x\n", "line 2: G = '2.x' is not a finite complex number"),
        ("f [Hz],mag [abs],phase [rad]\n1,-3,0\n2,-3,0\n", "is negative; is it in dB"),
        ("f [Hz],mag [dB],phase [rad]\n1,-3000,0\n2,-3,0\n", "beyond 300 dB"),
        ("1 2 3\n", "has no header: its line 1 holds 3 numbers"),
        ("", "is empty; allowed is a line of headings"),
    ],
)
def test_what_is_ambiguous_or_wrong_is_refused(tmp_path, text, said):
    path = tmp_path / "frf.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_frequency_response(path)
