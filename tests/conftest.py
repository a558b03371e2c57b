from hypothesis import settings

# The same examples in every run, and no time limit for one, so that a failure means the code.
settings.register_profile("fleetalign", deadline=None, derandomize=True)
settings.load_profile("fleetalign")
