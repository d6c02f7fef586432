"""Rules of the house that no linter has, read from the source."""

import ast

from structure import PACKAGE, sources


def self_attributes(method):
    """Names of the attributes that a method assigns to its object."""
    return {
        node.attr
        for node in ast.walk(method)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and isinstance(node.value, ast.Name)
        and node.value.id == 'self'
    }


def own_calls(method):
    """Names of the methods of its own object that a method calls."""
    called = [node.func for node in ast.walk(method) if isinstance(node, ast.Call)]
    return {
        function.attr
        for function in called
        if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) and function.value.id == 'self'
    }


def late_attributes(kind):
    """Attributes of a class that neither its body declares nor its constructor, with what that calls, assigns."""
    methods = {item.name: item for item in kind.body if isinstance(item, ast.FunctionDef)}
    declared = [item.target for item in kind.body if isinstance(item, ast.AnnAssign)]
    known = {target.id for target in declared if isinstance(target, ast.Name)}
    begun, waiting = set(), ['__init__']
    while waiting:
        name = waiting.pop()
        if name in methods and name not in begun:
            begun.add(name)
            known |= self_attributes(methods[name])
            waiting += own_calls(methods[name])
    return set().union(*map(self_attributes, methods.values())) - known


def test_no_function_is_longer_than_a_screen():
    long = [
        f'{path.relative_to(PACKAGE)}: {node.name}, {node.end_lineno - node.lineno + 1} lines'
        for path in sources(PACKAGE)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno >= 50
    ]
    assert long == []


def test_a_node_fits_on_a_screen():
    """It converts, makes one call of the core, and publishes."""
    lengths = {path.name: len(path.read_text().splitlines()) for path in sources(PACKAGE / 'nodes')}
    assert {name: length for name, length in lengths.items() if length > 100} == {}


def test_no_attribute_begins_outside_the_constructor():
    """Else it exists only after some other method has run, which a caller must know."""
    late = [
        f'{path.relative_to(PACKAGE)}: {kind.name}.{name}'
        for path in sources(PACKAGE)
        for kind in ast.walk(ast.parse(path.read_text()))
        if isinstance(kind, ast.ClassDef)
        for name in late_attributes(kind)
    ]
    assert late == []
