"""What a navigator puts out while no fixes come: models of an INS's error, learnt from the record before.

`regression.fit` makes a model by name; `outage.bridged` corrects a free-running INS by one.
"""
