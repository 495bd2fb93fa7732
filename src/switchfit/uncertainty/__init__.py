"""Uncertainty and checks of a fit: profiles, predictions, identifiability, residuals, certificate, verdict.

From the bottom to the top: `chi_square`, `residuals`, `explained_variance` and `quality` judge what is left of the
data; `derivative_check`, `identification` and `certificate` check the numbers; `doubts`, `issues`, `findings` and
`advice` lead to the `verdict`. `walks` to `transition_profiles` follow profiles of many transition times at once,
`profiles` one unknown with fits. Imports `fit` and the rooms before it.
"""
