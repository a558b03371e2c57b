"""Robust filters by linear matrix inequalities for a plant whose output arrives late at random.

`design.design` is the way in; `analysis` judges a filter without any solver. Source: C. Gao, J. Lu, G. Zhao,
S. Pan, "A Localization and In-flight Alignment Protocol for Airborne SINS Based on Flight-vehicle Wireless
Sensor Networks", eqs. (10) to (13).
"""
