"""Presentation of the study `mbds_xsim.learn.shift`: learned models under a change of engine."""
