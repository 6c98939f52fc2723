"""Text of the C headers; @PLACES@ are filled by `sofnn_torch.export.c`."""

FLOAT = """\
/* A policy that sofnn-torch learned: a fuzzy network of @RULES@ rules with Gaussian memberships.
 * C99, no allocation, no library but math.h. The state, in:
 *
@ABOUT@
 *
 * Call NAME_action(x) for the mean or greedy action, or NAME_outputs(x, y) for what the network
 * concludes; that returns the number of the rule that fires most. Nothing is left out of the
 * policy but chance: leaving loops is up to the caller (docs/export.md of sofnn-torch).
 */
@HEAD@
#ifndef @GUARD@
#define @GUARD@

#include <math.h>

enum { NAME_INPUTS = @INPUTS@, NAME_RULES = @RULES@, NAME_OUTPUTS = @OUTPUTS@ };

/* Of each rule: centres, widths, consequents. */
static const float NAME_rules[@RULES@][2 * @INPUTS@ + @OUTPUTS@] = {
@TABLE@
};

/* Outputs at the inputs of the rules; the number of the strongest. */
static inline int NAME_conclude(const float state[@INPUTS@], float y[@OUTPUTS@]) {
    float best = 0.0f, total = 0.0f;
    int strongest = 0, i, j, k;
    for (j = 0; j < NAME_OUTPUTS; j++) y[j] = 0.0f;
    for (k = 0; k < NAME_RULES; k++) {
        const float *rule = NAME_rules[k];
        float log_firing = 0.0f, weight;
        for (i = 0; i < NAME_INPUTS; i++) {
            float d = state[i] - rule[i];
@WRAP@
            d /= rule[NAME_INPUTS + i];
            log_firing -= 0.5f * d * d;
        }
        if (k == 0 || log_firing > best) { /* weights are relative to the strongest so far */
            const float scale = k == 0 ? 0.0f : expf(best - log_firing);
            total *= scale;
            for (j = 0; j < NAME_OUTPUTS; j++) y[j] *= scale;
            best = log_firing;
            strongest = k;
        }
        weight = expf(log_firing - best);
        total += weight;
        for (j = 0; j < NAME_OUTPUTS; j++) y[j] += weight * rule[2 * NAME_INPUTS + j];
    }
    for (j = 0; j < NAME_OUTPUTS; j++) y[j] /= total;
    return strongest;
}

static inline void NAME_state(const float x[@STATE@], float state[@INPUTS@]) {
    int i;
    for (i = 0; i < @STATE@; i++) state[i] = x[i];
@CLIP@
}

"""

FLOAT_OUTPUTS = """\
static inline int NAME_outputs(const float x[@STATE@], float y[@OUTPUTS@]) {
    float state[@INPUTS@];
    NAME_state(x, state);
    return NAME_conclude(state, y);
}

"""

FLOAT_VALUES = (
    FLOAT_OUTPUTS
    + """\
static const float NAME_codes[@CHOICES@][@CODE@] = {
@CODES@
};

static inline void NAME_values(const float x[@STATE@], float values[@CHOICES@]) {
    float y[@OUTPUTS@], state[@INPUTS@], of_state;
    int i, j;
    NAME_state(x, state);
    NAME_conclude(state, y);
    of_state = y[NAME_OUTPUTS - 1];
    for (i = 0; i < @STATE@; i++) of_state += y[i] * state[i];
    for (j = 0; j < @CHOICES@; j++) {
        values[j] = of_state;
        for (i = 0; i < @CODE@; i++) values[j] += y[@STATE@ + i] * NAME_codes[j][i];
    }
}

"""
)

FLOAT_ACTING = """\
static const float NAME_codes[@CHOICES@][@CODE@] = {
@CODES@
};

/* Outputs for a choice, which is an input of the rules. */
static inline int NAME_outputs(const float x[@STATE@], int choice, float y[@OUTPUTS@]) {
    float state[@INPUTS@];
    NAME_state(x, state);
    state[@STATE@] = NAME_codes[choice][0];
    return NAME_conclude(state, y);
}

static inline void NAME_values(const float x[@STATE@], float values[@CHOICES@]) {
    float y[@OUTPUTS@], state[@INPUTS@];
    int i, j;
    NAME_state(x, state);
    for (j = 0; j < @CHOICES@; j++) {
        NAME_outputs(x, j, y);
        values[j] = y[NAME_OUTPUTS - 1] + y[@STATE@] * NAME_codes[j][0];
        for (i = 0; i < @STATE@; i++) values[j] += y[i] * state[i];
    }
}

"""

CHOOSE = """\
static inline int NAME_choice(const float x[@STATE@]) {
    float values[@CHOICES@];
    int best = 0, j;
    NAME_values(x, values);
    for (j = 1; j < @CHOICES@; j++)
        if (values[j] > values[best]) best = j;
    return best;
}

"""

FLOAT_ACTS = {
    ("values", "discrete"): CHOOSE
    + "static inline int NAME_action(const float x[@STATE@]) { return NAME_choice(x); }\n",
    ("values", "continuous"): CHOOSE
    + """\
static inline void NAME_action(const float x[@STATE@], float action[1]) {
    static const float points[@CHOICES@] = {@POINTS@};
    action[0] = points[NAME_choice(x)];
}
""",
    ("normal", "discrete"): FLOAT_OUTPUTS
    + """\
static inline int NAME_action(const float x[@STATE@]) {
    static const float edges[@EDGE_COUNT@] = {@EDGES@};
    float y[@OUTPUTS@];
    int action = 0, j;
    NAME_outputs(x, y);
    for (j = 0; j < @EDGE_COUNT@; j++) action += y[0] > edges[j];
    return action;
}
""",
    ("normal", "continuous"): FLOAT_OUTPUTS
    + """\
static inline void NAME_action(const float x[@STATE@], float action[@NUMBERS@]) {
    float y[@OUTPUTS@];
    int j;
    NAME_outputs(x, y);
    for (j = 0; j < @NUMBERS@; j++)
        action[j] = y[j] < -1.0f ? -1.0f : y[j] > 1.0f ? 1.0f : y[j];
}
""",
}

END = "\n#endif\n"

FIXED = """\
/* A policy that sofnn-torch learned: a fuzzy network of @RULES@ rules with Gaussian memberships.
 * C99 in whole numbers: no allocation, no library, 16 bits in the table and 32 in between.
 * Equal to the model in sofnn_torch/export/fixed.py bit for bit. The state, in:
 *
@ABOUT@
 *
 * Call NAME_action(x). It is the mean or greedy action; leaving loops is up to the caller.
 */
@HEAD@
#ifndef @GUARD@
#define @GUARD@

#include <stdint.h>

#ifdef __AVR__ /* the table stays in the flash memory */
#include <avr/pgmspace.h>
#define NAME_TABLE PROGMEM
#define NAME_READ(p) pgm_read_word(p)
#else
#define NAME_TABLE
#define NAME_READ(p) (*(p))
#endif

/* Of each rule: centres, gains unless all have the same, conclusions. */
static const uint16_t NAME_rules[@RULES@][@COLUMNS@] NAME_TABLE = {
@TABLE@
};
@GAINS_TABLE@

static inline uint16_t NAME_times(uint16_t a, uint16_t b) {
    return (uint16_t)((uint32_t)a * b >> 16);
}

/* Sums of the conclusions, weighted; the sum of the weights, at least 2^15. */
static inline uint16_t NAME_sums(const uint16_t x[@INPUTS@], uint32_t sums[@SUMS@]@ARGUMENT@) {
    const uint16_t *p = NAME_rules[0];
    uint16_t nearest = 65535u, k;
    uint32_t total = 0;
    uint8_t i;
    @INDEX@ j;
    for (j = 0; j < @SUMS@; j++) sums[j] = 0;
    for (k = 0; k < @RULES@; k++, p += @COLUMNS@) {
        uint32_t z = 0;
        uint16_t whole, f, w;
        for (i = 0; i < @INPUTS@; i++) {
            uint16_t d = (uint16_t)(x[i] - NAME_READ(p + i));
            if (d & 0x8000u) d = (uint16_t)(0u - d);
            d = NAME_times(d, @GAIN@);
            z += (uint32_t)d * d;
        }
        whole = (uint16_t)(z >> @WHOLE@);
        if (whole < nearest) { /* weights are relative to the nearest rule so far */
            uint16_t drop = (uint16_t)(nearest - whole);
            if (drop > 31u) drop = 31u;
            total >>= drop;
            for (j = 0; j < @SUMS@; j++) sums[j] >>= drop;
            nearest = whole;
        }
        whole = (uint16_t)(whole - nearest);
        if (whole > 15u) continue;
        f = (uint16_t)(z >> @FRACTION@);
        w = NAME_times(f, (uint16_t)(@B@ - NAME_times(f, @C@)));
        w = (uint16_t)(65535u - NAME_times(f, (uint16_t)(@A@ - w))) >> whole;
        total += w;
        for (j = 0; j < @SUMS@; j++) sums[j] += (uint32_t)w * NAME_READ(p + @FIRST@ + j) >> @SHIFT@;
    }
    while (!(total >> @FULL@)) {
        total <<= 1;
        for (j = 0; j < @SUMS@; j++) sums[j] <<= 1;
    }
    return (uint16_t)(total >> @SHIFT@);
}

"""

FIXED_GAINS = "static const uint16_t NAME_gains[@INPUTS@] NAME_TABLE = {@GAINS@};\n"

FIXED_GREATEST = """\
static inline uint16_t NAME_choice(const uint16_t x[@STATE@]) {
    uint32_t sums[@SUMS@];
    uint16_t best = 0, j;
    NAME_sums(x, sums);
    for (j = 1; j < @SUMS@; j++)
        if (sums[j] > sums[best]) best = j;
    return best;
}

"""

FIXED_ACTING = """\
static inline uint16_t NAME_choice(const uint16_t x[@STATE@]) {
    static const uint16_t codes[@CONCLUSIONS@] = {@CODES@};
    uint16_t inputs[@INPUTS@], best = 0, j;
    uint32_t greatest = 0, sum[1];
    for (j = 0; j < @STATE@; j++) inputs[j] = x[j];
    for (j = 0; j < @CONCLUSIONS@; j++) {
        uint16_t total;
        inputs[@STATE@] = codes[j];
        total = NAME_sums(inputs, sum, j);
        sum[0] /= total;
        if (sum[0] > 65535u) sum[0] = 65535u;
        if (j == 0 || sum[0] > greatest) {
            greatest = sum[0];
            best = j;
        }
    }
    return best;
}

"""

CHOSEN = (
    "static inline uint16_t NAME_action(const uint16_t x[@STATE@]) { return NAME_choice(x); }\n"
)
POINTED = """\
/* The action is NAME_points[NAME_choice(x)], from -1 to 1: keep them in what your motors take. */
#define NAME_POINTS {@POINTS@}
"""

FIXED_ACTS = {
    ("values", "discrete"): FIXED_GREATEST + CHOSEN,
    ("values", "continuous"): FIXED_GREATEST + POINTED + CHOSEN,
    ("acting", "discrete"): FIXED_ACTING + CHOSEN,
    ("acting", "continuous"): FIXED_ACTING + POINTED + CHOSEN,
    ("normal", "discrete"): """\
static inline uint16_t NAME_action(const uint16_t x[@STATE@]) {
    static const uint16_t edges[@ENDS_COUNT@] = {@ENDS@};
    uint32_t sums[1];
    const uint16_t total = NAME_sums(x, sums);
    uint16_t action = 0;
    @INDEX@ j;
    for (j = 0; j < @ENDS_COUNT@; j++)
        if (sums[0] > (uint32_t)edges[j] * total) action++;
    return action;
}
""",
    ("normal", "continuous"): """\
static inline void NAME_action(const uint16_t x[@STATE@], uint16_t action[@SUMS@]) {
    uint32_t sums[@SUMS@];
    const uint16_t total = NAME_sums(x, sums);
    @INDEX@ j;
    for (j = 0; j < @SUMS@; j++) {
        sums[j] /= total;
        action[j] = sums[j] > 65535u ? 65535u : (uint16_t)sums[j];
@CLAMP@
    }
}
""",
}
