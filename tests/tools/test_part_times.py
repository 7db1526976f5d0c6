"""`trihedron benchmark parts`: a row for each part that OpenCV has too."""

from trihedron.pipeline.app.cli import main


def test_a_row_for_each_part(capsys):
    assert main(["benchmark", "parts", "--calls", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.rsplit(maxsplit=4)[0].strip() for line in lines[-4:]] == [
        "FAST corners",
        "binary descriptors",
        "line segments, half size",
        "matching",
    ]
    for line in lines[-4:]:
        p50, p95, opencv, multiple = map(float, line.rsplit(maxsplit=4)[1:])
        assert 0.0 < p50 <= p95 and opencv > 0.0 and multiple > 0.0


def test_calls_out_of_range(capsys):
    assert main(["benchmark", "parts", "--calls", "1"]) == 2
    assert capsys.readouterr().err == "trihedron: benchmark parts: --calls 1 is out of range; give 2 to 10000\n"
