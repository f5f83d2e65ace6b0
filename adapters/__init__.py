"""Adapters: one engine a package. Loaded by name by `mbds_xsim.simulate.registry`, not imported."""
