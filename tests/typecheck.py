"""The checker of annotations for `make test-types`: beartype, for which a whole number is a float, as for Python."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
