"""The companion papers' own experiments, each as published and as mended, judged claim by claim.

`scenario` says what can be run; a module named after each paper runs it and gives `results`; `statistics`,
`figures`, `report` and `command` are the same for all.
"""
