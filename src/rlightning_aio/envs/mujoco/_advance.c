/* One function, which MuJoCo's threads call for each simulation; see `outputs`.
 *
 * It needs neither Python nor MuJoCo's headers: MuJoCo's functions are given as pointers, and the
 * places of its fields as offsets.
 */

#ifndef Py_GIL_DISABLED
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef void (*Compute)(const void *model, void *data);
typedef void (*GetState)(const void *model, const void *data, double *state, int signature);

/* Of a draw, as NumPy declares them (numpy/random/bitgen.h). */
typedef struct {
    void *state;
    uint64_t (*next_uint64)(void *state);
    uint32_t (*next_uint32)(void *state);
    double (*next_double)(void *state);
    uint64_t (*next_raw)(void *state);
} Generator;
typedef double (*DrawNormal)(Generator *generator);

/* The same as the structures in outputs.py. */
typedef struct {
    double *observations; /* [simulations, width] */
    double *columns;      /* [all columns, simulations] */
    double *rewards;
    uint8_t *terminated;
    uint8_t *truncated;
    uint8_t *ended;       /* Either. */
} Frame;

typedef struct {
    int64_t kind;
    int64_t field;       /* Offset of the field's pointer in mjData. */
    int64_t first;       /* Of the field's values. */
    int64_t count;
    double low;
    double high;
    const double *weights;
    int64_t is_column;
    int64_t place;       /* In an observation, or of the first column. */
} Part;

/* What a step is worth: forward + alive - (control + contact). Places are columns, or -1. */
typedef struct {
    int64_t num_places;  /* The first columns are where the body is. */
    int64_t velocity;    /* Where its velocity and the cost of control are written. */
    int64_t healthy_at;
    int64_t control_at;  /* -1 for the squares of the controls. */
    int64_t contact_at;
    int64_t ends;        /* An unhealthy one is terminated. */
    double forward;
    double alive;
    double control;
    double contact;
    double low;
    double high;
    double *places;      /* Before the step, [num_places, simulations]. */
    const double *timestep;
} Terms;

/* How positions and velocities are drawn around the first ones. */
typedef struct {
    Generator **generators; /* Of each simulation. */
    DrawNormal normal;      /* Of velocities, or NULL if they are drawn uniformly, too. */
    double scale;
    const double *positions;
    const double *velocities;
} Noise;

typedef struct {
    Compute reset;
    Compute forward;
    Compute step;
    Compute finish; /* After the steps, or NULL. */
    GetState get_state;
    int64_t signature;
    int64_t num_moving;
    int64_t fields[3]; /* qpos, qvel, ctrl. */
    int64_t sizes[3];
    int64_t num_simulations;
    const int64_t *num_steps; /* Of each simulation; 0 for a reset. */
    double *starts;           /* Positions and velocities after a reset. */
    double *before;
    const void *controls;     /* Of float64, or float32 if `is_single`. */
    void *squares;            /* The sum of the squares of each simulation's controls, likewise. */
    int64_t is_single;
    int64_t warning;          /* Offset of the warnings in mjData. */
    int64_t unstable[3];      /* Their positions. */
    int64_t warned;           /* Set to 1 if a simulation got one of them. */
    int64_t draws;            /* Draw `starts` anew. */
    Noise noise;
    int64_t judges;           /* Write rewards and ends. */
    Terms terms;
    int64_t clock;            /* Steps of all, with this one. */
    int64_t limit;            /* Of steps in an episode. */
    int64_t *began;           /* The clock at the last reset of each simulation. */
    int64_t any_ended;        /* Set to 1 if an episode has ended. */
    const Frame *frame;
    int64_t width;
    int64_t num_parts;
    Part parts[];
} Plan;

/* MuJoCo's mjWarningStat. */
typedef struct {
    int lastinfo;
    int number;
} Warning;

enum { POSITIONS, VELOCITIES, CONTROLS };
enum { COPY, SQUARES, WITHIN, ALSO_WITHIN, CENTRE };

static double *
field_at(const void *data, int64_t offset)
{
    double *values;
    memcpy(&values, (const char *)data + offset, sizeof values);
    return values;
}

static void
put(const Plan *plan, void *data, int which, const double *values)
{
    memcpy(field_at(data, plan->fields[which]), values,
           (size_t)plan->sizes[which] * sizeof *values);
}

/* As NumPy's `clip`. */
static double
clipped(double value, double low, double high)
{
    if (isnan(value))
        return value;
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* Functions of their own, so that no compiler fuses a product and a sum into one rounding. */
static double
product(double one, double other)
{
    return one * other;
}

static double
square(double value)
{
    return value * value;
}

#define SUM(name, type, value)                                                                   \
    static type name##_term(const type *values, int64_t k, double low, double high)              \
    {                                                                                            \
        (void)low, (void)high;                                                                   \
        return value;                                                                            \
    }                                                                                            \
    /* In the order of NumPy's sums. */                                                          \
    static type name(const type *values, int64_t count, double low, double high)                 \
    {                                                                                            \
        type sums[8], sum = 0;                                                                   \
        int64_t k = 0;                                                                           \
        if (count > 128) {                                                                       \
            int64_t half = count / 2 - count / 2 % 8;                                            \
            return name(values, half, low, high)                                                 \
                   + name(values + half, count - half, low, high);                               \
        }                                                                                        \
        if (count >= 8) {                                                                        \
            for (; k < 8; k++)                                                                   \
                sums[k] = name##_term(values, k, low, high);                                     \
            for (; k < count - count % 8; k++) {                                                 \
                const type term = name##_term(values, k, low, high);                             \
                sums[k % 8] += term;                                                             \
            }                                                                                    \
            sum = ((sums[0] + sums[1]) + (sums[2] + sums[3]))                                    \
                  + ((sums[4] + sums[5]) + (sums[6] + sums[7]));                                 \
        }                                                                                        \
        for (; k < count; k++) {                                                                 \
            const type term = name##_term(values, k, low, high);                                 \
            sum += term;                                                                         \
        }                                                                                        \
        return sum;                                                                              \
    }

SUM(sum_of, double, values[k])
SUM(sum_of_squares, double, square(clipped(values[k], low, high)))
SUM(sum_of_single_squares, float, values[k] * values[k])

static int
is_within(const double *values, int64_t count, double low, double high)
{
    for (int64_t k = 0; k < count; k++)
        if (!(low < values[k] && values[k] < high))
            return 0;
    return 1;
}

/* The centre of bodies in the plane, in the order of NumPy's sums over the first of two axes. */
static void
find_centre(const Part *part, const double *from, double *to, int64_t column)
{
    const double *weights = part->weights;
    const int64_t bodies = part->count / 3;
    const double all = sum_of(weights, bodies, 0.0, 0.0);
    for (int64_t axis = 0; axis < 2; axis++) {
        double sum = product(weights[0], from[axis]);
        for (int64_t k = 1; k < bodies; k++)
            sum += product(weights[k], from[3 * k + axis]);
        to[axis * column] = sum / all;
    }
}

static void
copy_part(const Plan *plan, const Part *part, const void *data, int simulation)
{
    const double low = part->low, high = part->high;
    const double *from = field_at(data, part->field) + part->first;
    const int64_t column = part->is_column ? plan->num_simulations : 1;
    double *to = part->is_column
                     ? plan->frame->columns + part->place * plan->num_simulations + simulation
                     : plan->frame->observations + simulation * plan->width + part->place;
    if (part->kind == SQUARES)
        *to = sum_of_squares(from, part->count, low, high);
    else if (part->kind == WITHIN)
        *to = is_within(from, part->count, low, high);
    else if (part->kind == ALSO_WITHIN)
        *to = *to != 0.0 && is_within(from, part->count, low, high);
    else if (part->kind == CENTRE)
        find_centre(part, from, to, column);
    else if (column == 1 && isinf(low) && isinf(high))
        memcpy(to, from, (size_t)part->count * sizeof *to);
    else
        for (int64_t k = 0; k < part->count; k++)
            to[k * column] = clipped(from[k], low, high);
}

static void
take_controls(const Plan *plan, void *data, int simulation)
{
    const int64_t size = plan->sizes[CONTROLS];
    double *to = field_at(data, plan->fields[CONTROLS]);
    if (plan->is_single) {
        const float *from = (const float *)plan->controls + simulation * size;
        for (int64_t k = 0; k < size; k++)
            to[k] = from[k];
        ((float *)plan->squares)[simulation] = sum_of_single_squares(from, size, 0.0, 0.0);
    }
    else {
        const double *from = (const double *)plan->controls + simulation * size;
        memcpy(to, from, (size_t)size * sizeof *to);
        ((double *)plan->squares)[simulation] =
            sum_of_squares(from, size, -HUGE_VAL, HUGE_VAL);
    }
}

static int64_t
num_warnings(const Plan *plan, const void *data)
{
    int64_t found = 0;
    for (int k = 0; k < 3; k++) {
        Warning warning;
        memcpy(&warning,
               (const char *)data + plan->warning + plan->unstable[k] * (int64_t)sizeof warning,
               sizeof warning);
        found += warning.number;
    }
    return found;
}

/* As `Generator.uniform` and `Generator.standard_normal` draw. */
static void
draw_start(const Plan *plan, int simulation, double *start)
{
    const Noise *noise = &plan->noise;
    Generator *generator = noise->generators[simulation];
    const double low = -noise->scale, range = noise->scale - low;
    const int64_t *sizes = plan->sizes;
    double *velocities = start + sizes[POSITIONS];
    for (int64_t k = 0; k < sizes[POSITIONS]; k++) {
        const double drawn = low + product(range, generator->next_double(generator->state));
        start[k] = noise->positions[k] + drawn;
    }
    for (int64_t k = 0; k < sizes[VELOCITIES]; k++) {
        const double drawn =
            noise->normal != NULL
                ? product(noise->normal(generator), noise->scale)
                : low + product(range, generator->next_double(generator->state));
        velocities[k] = noise->velocities[k] + drawn;
    }
}

static void
settle(const Plan *plan, int simulation)
{
    const int64_t count = plan->num_simulations;
    for (int64_t k = 0; k < plan->terms.num_places; k++)
        plan->terms.places[k * count + simulation] =
            plan->frame->columns[k * count + simulation];
}

static double
cost_of_control(const Plan *plan, const double *columns, int simulation)
{
    const Terms *terms = &plan->terms;
    if (terms->control_at >= 0)
        return product(terms->control, columns[terms->control_at * plan->num_simulations]);
    if (!plan->is_single)
        return product(terms->control, ((const double *)plan->squares)[simulation]);
    return (float)terms->control * ((const float *)plan->squares)[simulation];
}

/* See `tasks.Walker.judge`, the twin. Return the reward. */
static double
judge(const Plan *plan, int simulation, int64_t num_steps, int *is_terminated)
{
    const Terms *terms = &plan->terms;
    const int64_t count = plan->num_simulations;
    double *columns = plan->frame->columns + simulation;
    double *velocity = columns + terms->velocity * count;
    const double seconds = *terms->timestep * (double)num_steps;
    for (int64_t k = 0; k < terms->num_places; k++)
        velocity[k * count] =
            (columns[k * count] - terms->places[k * count + simulation]) / seconds;
    double reward = product(terms->forward, velocity[0]);
    if (terms->healthy_at >= 0) {
        const int is_healthy = columns[terms->healthy_at * count] != 0.0;
        reward += product(is_healthy, terms->alive);
        *is_terminated = terms->ends && !is_healthy;
    }
    double cost = cost_of_control(plan, columns, simulation);
    velocity[terms->num_places * count] = cost;
    if (terms->contact_at >= 0)
        cost += clipped(product(terms->contact, columns[terms->contact_at * count]), terms->low,
                        terms->high);
    return reward - cost;
}

/* An mjfBatchFunc. */
static void
advance(const void *model, void *data, int simulation, void *argument)
{
    Plan *plan = argument;
    int64_t num_steps = plan->num_steps[simulation];
    double *before = plan->before + simulation * plan->num_moving;
    if (num_steps == 0) {
        const int64_t *sizes = plan->sizes;
        double *start = plan->starts + simulation * (sizes[POSITIONS] + sizes[VELOCITIES]);
        if (plan->draws)
            draw_start(plan, simulation, start);
        plan->reset(model, data);
        put(plan, data, POSITIONS, start);
        put(plan, data, VELOCITIES, start + sizes[POSITIONS]);
        plan->forward(model, data);
        plan->get_state(model, data, before, (int)plan->signature);
    }
    else {
        int64_t warnings = num_warnings(plan, data);
        take_controls(plan, data, simulation);
        plan->get_state(model, data, before, (int)plan->signature);
        for (int64_t k = 0; k < num_steps; k++)
            plan->step(model, data);
        if (plan->finish != NULL)
            plan->finish(model, data);
        if (num_warnings(plan, data) != warnings)
            __atomic_store_n(&plan->warned, 1, __ATOMIC_RELAXED);
    }
    for (int64_t k = 0; k < plan->num_parts; k++)
        copy_part(plan, &plan->parts[k], data, simulation);
    if (plan->judges) {
        const Frame *frame = plan->frame;
        int terminated = 0;
        double reward = 0.0;
        if (num_steps == 0)
            plan->began[simulation] = plan->clock;
        else
            reward = judge(plan, simulation, num_steps, &terminated);
        const int truncated = plan->clock - plan->began[simulation] >= plan->limit;
        frame->rewards[simulation] = reward;
        frame->terminated[simulation] = (uint8_t)terminated;
        frame->truncated[simulation] = (uint8_t)truncated;
        frame->ended[simulation] = (uint8_t)(terminated || truncated);
        if (terminated || truncated)
            __atomic_store_n(&plan->any_ended, 1, __ATOMIC_RELAXED);
    }
    if (plan->judges || num_steps == 0) /* Else the twin needs the places before. */
        settle(plan, simulation);
}

static int
add_address(PyObject *module)
{
    PyObject *address = PyLong_FromVoidPtr((void *)(uintptr_t)advance);
    int failed = PyModule_AddObjectRef(module, "ADVANCE", address);
    Py_XDECREF(address);
    return failed ? failed
                  : PyModule_AddIntConstant(module, "PLAN_SIZE", sizeof(Plan) + sizeof(Part));
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, add_address},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_NOT_USED},
#endif
    {0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "rlightning_aio.envs.mujoco._advance",
    .m_doc = "ADVANCE: the address of a function for `mjb_apply`; PLAN_SIZE: of its argument, with one part.",
    .m_slots = slots,
};

PyMODINIT_FUNC
PyInit__advance(void)
{
    return PyModuleDef_Init(&module);
}
