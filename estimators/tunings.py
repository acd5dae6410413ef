"""Process noise of each filter with each slow sensor.

Per second, in (unit of the state)^2 / s. The papers print none. These minimise the mean squared
error of beta (Nelder-Mead on the logarithms, from several starts, at least 1e-8) over 12 training
seeds (1000 to 1011, apart from the test seeds) of linear simulations: tie-vision-fig7 for the
filters of the camera and `bicycle-kf`, dakf-fig6 for those of the course. The minima are flat: half
or double a number changes the error by a few per cent. Not from there: psi of the course filters
(as good as 1e-8 there, and a gyro bias turns beta less), `single-rate-kf` with the course (at 5 Hz
it holds its estimate for so long that the optimum ignores the sensor) and `exact-kf` (it knows its
model, so that only the disturbances drive it).
"""

TUNINGS: dict[tuple[str, str], dict[str, float]] = {
    ("bicycle-kf", ""): {"beta": 1.7e-3, "gamma": 1.1e-2},
    ("single-rate-kf", "camera"): {"beta": 2.8e-3, "gamma": 1.0e-2, "psi": 4.2e-4, "y_l": 1e-8},
    ("multirate-kf", "camera"): {"beta": 2.7e-3, "gamma": 1.6e-2, "psi": 8.3e-7, "y_l": 1e-8},
    ("multirate-residual-kf", "camera"): {
        "beta": 0.12,
        "gamma": 0.57,
        "psi": 1.9e-4,
        "y_l": 6.7e-5,
    },
    ("single-rate-kf", "gps"): {"beta": 1e-3, "gamma": 1e-2, "psi": 5e-8},
    ("multirate-kf", "gps"): {"beta": 9.8e-3, "gamma": 6.9e-3, "psi": 5e-8},
    ("multirate-residual-kf", "gps"): {"beta": 1.8e-2, "gamma": 1.4e-2, "psi": 5e-8},
    ("course-kf", "gps"): {"beta": 9.8e-3, "gamma": 6.9e-3, "psi": 5e-8},
    ("dakf", "gps"): {"beta": 3.7e-4, "gamma": 4.2e-4, "psi": 1.2e-8, "d1": 3.3e-2, "d2": 0.21},
    ("uneven-delay-kf", "camera"): {"beta": 2.7e-3, "gamma": 1.6e-2, "psi": 8.3e-7, "y_l": 1e-8},
    ("constant-delay-kf", "camera"): {"beta": 2.7e-3, "gamma": 1.6e-2, "psi": 8.3e-7, "y_l": 1e-8},
    ("vision-only-kf", "camera"): {"beta": 2.7e-3, "gamma": 1.6e-2, "psi": 8.3e-7, "y_l": 1e-8},
    ("double-layer", "gps"): {
        "beta": 3.7e-4,
        "gamma": 4.2e-4,
        "psi": 1.2e-8,
        "d1": 3.3e-2,
        "d2": 0.21,
        "v_x": 1e-4,
        "v_y": 1e-4,
        "phi": 1e-6,
        "phi_rate": 1e-3,
        "d": 1.0,
    },
    ("roll-kf", ""): {"phi": 1e-4, "phi_rate": 1e-2},
    ("kinematic-velocity-kf", ""): {"v_x": 1e-3, "v_y": 1e-3},
    ("lob-2", ""): {"beta": 1.7e-3, "gamma": 1.1e-2},
    ("lob", ""): {"beta": 1.7e-3, "gamma": 1.1e-2},
    ("yaw-moment-observer", ""): {"gamma": 1e-2, "N_d": 1e4},
    ("lateral-force-observer", ""): {"gamma": 1e-2, "F_yf": 1e5, "F_yr": 1e5},
    ("dual-rate", "gps"): {"beta": 1e-4, "gamma": 1e-4, "psi": 1e-6, "d1": 1e-2, "d2": 0.1},
}
