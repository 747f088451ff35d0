"""The rows of the gamma and the beta distribution: quantiles are solved, in the logarithm of a
gamma number and in the logit of a beta one, by their incomplete functions in whichever tail is
small.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import lgamma
from jax.scipy.special import betainc, betaln, digamma, gammainc, gammaincc, polygamma

from jast._src.distributions import continuous
from jast._src.distributions.family_table import register_both
from jast._src.distributions.log_tail_rows import of_inverse
from jast._src.distributions.normal_tails import log_one_less, log_tails, normal_of_log_tails
from jast._src.distributions.numerically_inverted import newton
from jast._src.distributions.tables import interpolated, serves, tail

LEAST = 1e-290  # below it the first term of a series at 0 is exact
NEAR = -12.0  # the logit below which the first terms of the series at 0 are exact enough


def _known(d):
    return getattr(d, "_known_numbers", None)  # distrax has classes of its own


def _sure(below: jax.Array, above: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The logs of two probabilities, each from the other where that is small."""
    low, high = jnp.log(below), jnp.log(above)
    return (
        jnp.where(below < above, low, log_one_less(jnp.minimum(high, 0))),
        jnp.where(below < above, log_one_less(jnp.minimum(low, 0)), high),
    )


def gamma_tails(a: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(log P(X <= e^y), log P(X > e^y)) of shape ``a`` and rate 1."""
    x = jnp.exp(y)
    low, high = _sure(gammainc(a, x), gammaincc(a, x))
    # DLMF 8.7.1, to its second term, where x may be below the least float
    series = a * y - x - lgamma(a + 1) + jnp.log1p(x / (a + 1))
    near = x < 1e-4
    return jnp.where(near, series, low), jnp.where(near, log_one_less(series), high)


def _log_gamma(a, y):
    return a * y - jnp.exp(y) - lgamma(a)


def _score_gamma(a, y):
    return normal_of_log_tails(*gamma_tails(a, y))


def _log_of_gamma(a, z):
    """On the host."""
    from scipy import special

    p = tail(z)
    x = np.where(z < 0, special.gammaincinv(a, p), special.gammainccinv(a, p))
    small = (np.log(p) + special.gammaln(a + 1)) / a  # DLMF 8.7.1
    return np.where(x > LEAST, np.log(np.maximum(x, LEAST)), small)


def _gamma(d, z):
    known = _known(d)
    if serves(known, z):
        return jnp.exp(interpolated(_log_of_gamma, known[:1], z)) / d.rate
    a = jnp.broadcast_to(d.concentration, jnp.shape(z)).astype(z.dtype)
    cube = 1 - 1 / (9 * a) + z / (3 * jnp.sqrt(a))  # Wilson and Hilferty 1931
    small = (log_tails(z)[0] + lgamma(a + 1)) / a
    guess = jnp.where(cube > 0.3, jnp.log(a) + 3 * jnp.log(jnp.maximum(cube, 0.3)), small)
    return jnp.exp(newton(_score_gamma, _log_gamma, a, z, guess)) / d.rate


def _tails_gamma(d, x):
    return gamma_tails(d.concentration, jnp.log(jnp.maximum(x * d.rate, 0)))


def _mode_of_gamma(d):
    """The mean where the density has no maximum."""
    return jnp.where(d.concentration < 1, d.mean(), d.mode())


register_both(continuous.Gamma, mode=_mode_of_gamma, **of_inverse(_gamma, _tails_gamma))


def beta_tails(a: jax.Array, b: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(log P(X <= x), log P(X > x)) at the logit ``y`` of x."""
    below, above = _sure(betainc(a, b, jax.nn.sigmoid(y)), betainc(b, a, jax.nn.sigmoid(-y)))
    for_low, for_high = _first_of_beta(a, b, y), _first_of_beta(b, a, -y)
    near, far = y < NEAR, -y < NEAR
    below = jnp.where(near, for_low, jnp.where(far, log_one_less(for_high), below))
    return below, jnp.where(far, for_high, jnp.where(near, log_one_less(for_low), above))


def _first_of_beta(a, b, y):
    """log P(X <= x) by the first terms of the series at 0 (DLMF 8.17.7), where x may be below the
    least float.
    """
    x = jnp.exp(jnp.minimum(y, NEAR))
    return (
        -a * jax.nn.softplus(-y) - jnp.log(a) - betaln(a, b) + jnp.log1p((1 - b) * a / (a + 1) * x)
    )


def _log_beta(shapes, y):
    a, b = shapes
    return -a * jax.nn.softplus(-y) - b * jax.nn.softplus(y) - betaln(a, b)


def _score_beta(shapes, y):
    return normal_of_log_tails(*beta_tails(*shapes, y))


def _logit(log_x):
    log_x = jnp.minimum(log_x, -1e-6)
    return log_x - jnp.log(-jnp.expm1(log_x))


def _logit_of_beta(a, b, z):
    """On the host."""
    from scipy import special

    p = tail(z)
    a, b = np.where(z < 0, a, b), np.where(z < 0, b, a)
    x = special.betaincinv(a, b, p)
    small = (np.log(p) + np.log(a) + special.betaln(a, b)) / a  # DLMF 8.17.7
    y = np.where(x > LEAST, special.logit(np.maximum(x, LEAST)), small)
    return np.where(z < 0, y, -y)


def _beta(d, z):
    if serves(known := _known(d), z):
        return jax.nn.sigmoid(interpolated(_logit_of_beta, known, z))
    a, b = (jnp.broadcast_to(v, jnp.shape(z)).astype(z.dtype) for v in (d.alpha, d.beta))
    guess = digamma(a) - digamma(b) + jnp.sqrt(polygamma(1, a) + polygamma(1, b)) * z
    # by the first term of the series of the small tail: beyond it for shapes below 1
    below, above = (t + betaln(a, b) for t in log_tails(z))
    low, high = _logit((below + jnp.log(a)) / a), -_logit((above + jnp.log(b)) / b)
    low = jnp.where(a < 1, jnp.minimum(guess, low), jnp.maximum(guess, low))
    high = jnp.where(b < 1, jnp.maximum(guess, high), jnp.minimum(guess, high))
    guess = jnp.where(z < 0, low, high)
    return jax.nn.sigmoid(newton(_score_beta, _log_beta, (a, b), z, guess))


def _tails_beta(d, x):
    kind = jnp.finfo(x.dtype)  # at an end of the support half a unit of rounding from there
    low, high = jnp.maximum(x, kind.tiny), jnp.maximum(1 - x, kind.eps / 4)
    logit = jnp.log(jnp.minimum(low, 1)) - jnp.log(jnp.minimum(high, 1))
    below, above = beta_tails(d.alpha, d.beta, logit)
    sure, never = jnp.zeros_like(below), jnp.full_like(below, -jnp.inf)
    below = jnp.where(x < 0, never, jnp.where(x > 1, sure, below))
    return below, jnp.where(x < 0, sure, jnp.where(x > 1, never, above))


def _mode_of_beta(d):
    """The mean where the density has no maximum, or is the same everywhere."""
    a, b = d.alpha, d.beta
    return jnp.where((a < 1) | (b < 1) | ((a == 1) & (b == 1)), d.mean(), d.mode())


register_both(continuous.Beta, mode=_mode_of_beta, **of_inverse(_beta, _tails_beta))
