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
 * C99 in whole numbers: no allocation, no library, 16 bits in the tables and 32 in between.
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

#ifdef __AVR__ /* the tables stay in the flash memory */
#include <avr/pgmspace.h>
#define NAME_TABLE PROGMEM
#define NAME_READ(p) pgm_read_word(p)
#define NAME_BYTE(p) pgm_read_byte(p)
#define NAME_CALLED __attribute__((noinline)) /* smaller */
#else
#define NAME_CALLED
#define NAME_TABLE
#define NAME_READ(p) (*(p))
#define NAME_BYTE(p) (*(p))
#endif

/* Of each rule: centres; gains, one row if all have the same; conclusions. */
static const uint@BITS@_t NAME_centres[@RULES@][@INPUTS@] NAME_TABLE = {
@CENTRES@
};
static const uint@BITS@_t NAME_gains[@GAIN_ROWS@][@INPUTS@] NAME_TABLE = {
@GAINS@
};
static const uint8_t NAME_rules[@RULES@][@CONCLUSIONS@] NAME_TABLE = {
@TABLE@
};

static NAME_CALLED uint32_t NAME_product(uint16_t a, uint16_t b) { return (uint32_t)a * b; }

static NAME_CALLED uint16_t NAME_times(uint16_t a, uint16_t b) {
    return (uint16_t)(NAME_product(a, b) >> 16);
}

/* Sums of the conclusions, weighted; the sum of the weights, at least 65535. */
static inline uint32_t NAME_sums(const uint16_t x[@INPUTS@], uint32_t sums[@SUMS@]@ARGUMENT@) {
    uint32_t total = 0;
    uint16_t nearest = 65535u, k;
    uint8_t pass, i;
    @INDEX@ j;
    for (j = 0; j < @SUMS@; j++) sums[j] = 0;
    for (pass = 0; pass < 2; pass++) { /* weights are relative to the nearest rule */
        const uint@BITS@_t *p = NAME_centres[0];
        const uint8_t *c = NAME_rules[0];
        const uint@BITS@_t *g = NAME_gains[0];
        for (k = 0; k < @RULES@; k++, c += @CONCLUSIONS@) {
            uint16_t z = 0, f, w;
            for (i = 0; i < @INPUTS@; i++) {
                uint16_t d = (uint16_t)(x[i] - @CENTRE@);
                uint32_t r;
@OWN@
                if (d & 0x8000u) d = (uint16_t)~d;
@SCALED@
                if (r > @MOST@) r = @MOST@;
                z = (uint16_t)(z + NAME_times((uint16_t)r, (uint16_t)r));
            }
@SAME_GAINS@
            if (!pass) {
                if (z < nearest) nearest = z;
                continue;
            }
            z = (uint16_t)(z - nearest);
            if (z >> 12) continue;
            f = (uint16_t)(z << 8);
            w = NAME_times(f, (uint16_t)(@B@ - NAME_times(f, @C@)));
            w = (uint16_t)((uint16_t)(65535u - NAME_times(f, (uint16_t)(@A@ - w))) >> (z >> 8));
            total += w;
            for (j = 0; j < @SUMS@; j++) sums[j] += NAME_product(w, NAME_BYTE(c + j@FIRST@)) >> 8;
        }
    }
    return total;
}

"""

FIXED_GREATEST = """\
static inline uint16_t NAME_choice(const uint16_t x[@STATE@]) {
    uint32_t sums[@SUMS@];
    uint16_t best = 0, j;
    (void)NAME_sums(x, sums);
    for (j = 1; j < @SUMS@; j++)
        if (sums[j] > sums[best]) best = j;
    return best;
}

"""

SHARE = """\
/* A sum over the greater sum of the weights, in units of 2^-16. */
static inline uint16_t NAME_share(uint32_t sum, uint32_t total) {
    uint16_t share = 0;
    uint8_t i;
    for (i = 0; i < 16; i++) {
        sum <<= 1;
        share = (uint16_t)(share << 1);
        if (sum >= total) {
            sum -= total;
            share++;
        }
    }
    return share;
}

"""

FIXED_ACTING = (
    SHARE
    + """\
static inline uint16_t NAME_choice(const uint16_t x[@STATE@]) {
    static const uint16_t codes[@CONCLUSIONS@] = {@CODES@};
    uint16_t inputs[@INPUTS@], best = 0, greatest = 0, j;
    uint32_t sum[1];
    for (j = 0; j < @STATE@; j++) inputs[j] = x[j];
    for (j = 0; j < @CONCLUSIONS@; j++) {
        uint32_t total;
        uint16_t value;
        inputs[@STATE@] = codes[j];
        total = NAME_sums(inputs, sum, j);
        value = NAME_share(sum[0], total);
        if (j == 0 || value > greatest) {
            greatest = value;
            best = j;
        }
    }
    return best;
}

"""
)

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
    ("normal", "discrete"): SHARE
    + """\
static inline uint16_t NAME_action(const uint16_t x[@STATE@]) {
    static const uint16_t edges[@ENDS_COUNT@] = {@ENDS@};
    uint32_t sums[1];
    const uint32_t total = NAME_sums(x, sums);
    const uint16_t mean = NAME_share(sums[0], total);
    uint16_t action = 0;
    @INDEX@ j;
    for (j = 0; j < @ENDS_COUNT@; j++)
        if (mean > edges[j]) action++;
    return action;
}
""",
    ("normal", "continuous"): SHARE
    + """\
static inline void NAME_action(const uint16_t x[@STATE@], uint16_t action[@SUMS@]) {
    uint32_t sums[@SUMS@];
    const uint32_t total = NAME_sums(x, sums);
    @INDEX@ j;
    for (j = 0; j < @SUMS@; j++) {
        action[j] = NAME_share(sums[j], total);
@CLAMP@
    }
}
""",
}
