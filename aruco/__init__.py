"""The tools of rigcal: one algorithm a module; arrays and small frozen types in and out."""
