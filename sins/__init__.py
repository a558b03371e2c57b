"""Strapdown inertial navigation: earth, attitude, sensor errors, mechanisation, error dynamics.

Conventions, valid in every room of fleetalign
-----------------------------------------------
Frames
    i: inertial, fixed in space, coincides with e at time zero.
    e: earth-centred earth-fixed, WGS84.
    n: local level, north-east-down (NED) at the geodetic position.
    b: body, forward-right-down (FRD).
Vectors and rotations
    ``v_n`` is a vector resolved in n. ``C_nb`` and ``q_nb`` take body components to navigation
    components, ``v_n = C_nb @ v_b``. Quaternions are Hamilton's, scalar first, ``(w, x, y, z)``.
    ``w_ib_b`` is the rate of b relative to i, resolved in b.
Position
    ``lla``: geodetic latitude and longitude in rad, height above the ellipsoid in m.
Increments
    ``dtheta_b`` (rad) is the integral of the angular rate and ``dv_b`` (m/s) that of the specific
    force, both resolved in the moving body frame, over the interval that *ends* at ``time``.
Errors
    An error is computed minus true. Misalignment ``phi`` is the rotation vector from the true n to
    the computed n: ``C_nb_computed = (I - [phi x]) C_nb``.
Units
    SI and radians. Any other unit is in the name: ``_deg``, ``_arcsec``, ``_ug``, ``_deg_h``.
Arrays
    float64, time along the first axis.
"""
