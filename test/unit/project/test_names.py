"""A name says what a thing is: each of the package's classes and modules has its own."""

from structure import repeated_names


def test_no_class_or_module_has_the_name_of_another():
    assert repeated_names() == []
