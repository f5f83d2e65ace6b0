"""Adapters, one package per engine; `mbds_xsim.simulate.registry` loads them by name."""
