"""Misprints and contradictions of the source, and how this program reads them."""

from __future__ import annotations

from thesis.tables import Lines

# where, what our text has (short quotation or description), how it is read
MISPRINTS = (
    (
        "(2.1), text",
        'the scaling factor a12 "can never be equal to zero"',
        (
            "It is zero when the world's origin lies in the camera's principal plane, and near "
            "there the solution with a12 = 1 loses its digits. The program solves for a vector of "
            "unit norm; `rig.thesis_dlt` keeps a12 = 1 for comparison."
        ),
    ),
    (
        "(2.3)",
        "\"- x'X - x'Z\" in the first row, \"- y'X - y'Y\" in the second",
        (
            "From (2.1) both rows have three such terms: -x'X, -x'Y, -x'Z and -y'X, -y'Y, -y'Z; "
            "the first row holds four zeros."
        ),
    ),
    (
        "(2.6) and (5.1)",
        "new threshold = mean below + mean above",
        (
            "The factor 1/2 is missing: the iteration as printed does not settle between the "
            "classes. Read as half the sum (Ridler and Calvard 1978; Trussell 1979)."
        ),
    ),
    (
        "(2.9), (2.11)",
        '"a1 - a2 x\'" at the first place; "b2 - b11 x\'\'" at the third',
        "a1 - a9 x' and b3 - b11 x'', as (5.6) has it.",
    ),
    (
        "section 2.3",
        '"5 mm equal spacings" of the dots',
        "Figures 2.5 to 2.9 have a pitch of 6.35 mm (1/4 inch); the figures are followed.",
    ),
    (
        "section 3.2",
        '"a black disk of a radius 5 mm"',
        (
            "Nine discs of 10 mm would overlap at a pitch of 5 or 6.35 mm: chapter 3 used another "
            "target than chapter 2, a single disc."
        ),
    ),
    (
        "sections 2.3 and 3.3",
        'dial gauges with a "maximum stroke of 12.7 mm"',
        (
            "The planes of chapter 2 span 15.24 mm and the check rows reach 22.86 mm below the "
            "highest plane; the gauges must have been reset, which is not described."
        ),
    ),
    (
        "section 4.2",
        'erosion and dilation "often referred to as closing and opening"',
        "They are not: an opening is an erosion followed by a dilation, a closing the reverse.",
    ),
    (
        "section 5.2, step 6",
        '"the neighborhood range determined at step 2"',
        "Step 3.",
    ),
    (
        "(5.2)",
        '"a3 - y\'" on the left-hand side',
        "a8 - y'.",
    ),
    (
        "section 5.4",
        "(x', y') \"on the imaging plane of the right camera\"",
        "Camera 1, which is the left camera everywhere else.",
    ),
    (
        "section 5.6, example 1",
        "Z_lower = +50 mm is the plane nearest to the cameras, Z_upper = -50 mm the farthest",
        (
            "The names follow the distance from the cameras, not Z. The program has neither: "
            "the measuring volume is in world coordinates."
        ),
    ),
    (
        "section 5.6, example 2 and Figure 5.16",
        '"59x59" in the text, "60x60 pixels" under the figure',
        "59: a structuring element with a centre pixel has an odd side.",
    ),
    (
        "(6.4), text",
        '"substituting Eq. (6.2) into (6.1)"',
        (
            "The reverse. In (6.4) the K are subtracted from the observed position, in (6.5) they "
            "are added: the same letters have opposite signs."
        ),
    ),
    (
        "(6.5)",
        '"K r^6" without index, "2y_j^2" without bar, P3 named but absent',
        "K3 r^6; r^2 + 2 y^2 with the coordinate reduced to the centre; two tangential terms.",
    ),
    (
        "before (6.6)",
        '"y_c = x_d + ..."',
        "y_c = y_d + delta y; the last row of (6.6) ends in 1.",
    ),
    (
        "(6.7)",
        '"a12 y^2" in f2; "r^2 + 2(x^2)" in f1',
        "a12 r^2 in both; r^2 + 2 x_d^2; the last term of f1 is a16 2 x_d y_d.",
    ),
    (
        "before (6.8)",
        '"a is a 2-dimensional vector"',
        "16-dimensional: j = 1 ... 16.",
    ),
    (
        "(6.8)",
        "a sum of f without a square",
        "A sum of squares, as (6.13).",
    ),
    (
        "after (6.13)",
        "convergence when abs(a_j) / (0.001 + abs(a_j)) is at most 0.00001",
        "The numerator is the change of a_j; the condition carries no number in our text.",
    ),
    (
        "section 6.5",
        '"the error criterion of equation (6.14) is used"',
        "The criterion is (6.13); (6.14) is the condition of convergence.",
    ),
    (
        "Figure 2.9, row 64",
        "nominal X 5.24, calculated 4.49, error .75",
        (
            "Consistent in print, hence a blunder of the source and not of our text. It adds "
            "0.0117 mm to the printed X average and is set apart above."
        ),
    ),
    (
        "Table 5.2 and section 5.7",
        '26.77 against 25.19 mm; "within 1.5 mm"',
        "The error is 1.58 mm.",
    ),
    (
        "reference [48]",
        '"Common Picture Thresholding Using an Herative Selection Method"',
        (
            'H. J. Trussell, Comments on "Picture thresholding using an iterative selection '
            'method", '
            "IEEE Transactions on Systems, Man, and Cybernetics 9 (1979) 311."
        ),
    ),
)


def misprints_section() -> Lines:
    """List what the source has and how it was read."""
    lines = [
        "## Misprints and how they were read",
        "",
        (
            "Our text of the thesis is a machine reading of a microfilm. Some of these slips may "
            "be the reader's and not the author's. Repairs of single digits are not listed here: "
            "each of the 256 is in `data/thesis/repairs.csv` with its reason."
        ),
        "",
        "| where | the text has | read as |",
        "| --- | --- | --- |",
    ]
    lines += [f"| {where} | {has} | {read} |" for where, has, read in MISPRINTS]
    return [*lines, ""]
