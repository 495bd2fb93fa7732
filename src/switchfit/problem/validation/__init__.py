"""Checks of users' arguments: each function returns the value in the form that the code uses, or raises.

Every public constructor, function and method passes its arguments through here, so that a mistake is reported in one
sentence where it was made, and not by an error of NumPy or JAX somewhere inside. A message names the argument, the
required form and the value that was given (shortened, `messages.shorten`).

- `TypeError` for a wrong type, `ValueError` for a wrong value. Text in place of a number is a wrong value, as it is for
  ``float("x")``.

Problem files are validated with pydantic, Python calls are not. pydantic does not handle arrays, precision, masks or
dates, so that every field would need a validator of its own, like the functions here; its errors are tables about a
model class instead of a sentence about an argument; and it takes longer to import than everything else that `import
switchfit` loads.
"""
