"""A maze that a compliant tip feels its way through, blind, in MuJoCo; and a point in a plane."""
