"""C headers: no warning of a compiler, equal to torch or bit for bit to the model, small."""

import ctypes
import dataclasses
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from exported import ALL, learner, states
from test_export import command, margins  # noqa: F401

from sofnn_torch.export import c, fixed, policy, runtime
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config

STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-std=c99"]
needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc")


def needs(*tools):
    missing = [tool for tool in tools if not shutil.which(tool)]
    return pytest.mark.skipif(bool(missing), reason=f"no {' and no '.join(missing)}")


def header(folder, kind, precision, **options):
    """A header policy.h of a learner with rules by chance; the neutral policy and the learner."""
    config, agent = learner(kind, **options)
    data = policy.describe(config, agent)
    path = folder / "policy.h"
    path.write_bytes(c.to_header(data, path, precision))
    return path, data, (config, agent)


def program(folder, number, inputs, answer, compiler=("gcc", "-O2"), warnings=STRICT):
    """Compiles a program that reads states and writes an answer for each."""
    source = folder / "main.c"
    source.write_text(
        f'#include <stdio.h>\n#include "policy.h"\nint main(void) {{\n    {number} x[{inputs}];\n'
        f"    while (fread(x, sizeof x, 1, stdin) == 1) {{\n        {answer}\n"
        "        fwrite(out, sizeof out, 1, stdout);\n    }\n    return 0;\n}\n"
    )
    done = subprocess.run(
        [*compiler, *warnings, source, "-o", folder / "main", "-lm"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder / "main"


def answers(main, x, kind):
    out = subprocess.run([main], input=x.tobytes(), capture_output=True, check=True).stdout
    return np.frombuffer(out, kind).reshape(len(x), -1)


@needs_gcc
@pytest.mark.parametrize("kind", ALL)
def test_the_float_header_decides_as_torch(tmp_path, kind):
    _, data, (_, agent) = header(tmp_path, kind, "float")
    ours, x = runtime.Policy(data), states(agent, 500)
    if data["discrete"]:
        answer = "int out[1]; out[0] = policy_action(x);"
        main = program(tmp_path, "float", len(data["axes"]), answer)
        found, expected = answers(main, x, np.int32)[:, 0], agent.plan(seen(ours, x)).actions
        assert ((found == expected) | (margins(ours, x) < 1e-5)).all()
    else:
        numbers = len(data["actions"])
        answer = f"float out[{numbers}]; policy_action(x, out);"
        main = program(tmp_path, "float", len(data["axes"]), answer)
        found, expected = answers(main, x, np.float32), agent.plan(seen(ours, x)).actions
        near = np.abs(found - expected).max(1) < 2e-5
        assert (near | (margins(ours, x) < 1e-5)).all()


def seen(ours, x):
    return ours.state(x).astype(np.float32)


@needs_gcc
@pytest.mark.parametrize("kind", ["steer", "q", "q antecedent"])
def test_the_float_header_concludes_what_the_network_does(tmp_path, kind):
    _, data, (_, agent) = header(tmp_path, kind, "float")
    x, count = states(agent, 200), len(data["outputs"])
    choice = "1, " if kind == "q antecedent" else ""
    answer = f"float out[{count} + 1]; out[{count}] = (float)policy_outputs(x, {choice}out);"
    found = answers(program(tmp_path, "float", 3, answer), x, np.float32)
    with torch.no_grad():
        inputs = torch.from_numpy(x)
        inputs = agent.network_inputs(inputs)[:, 1] if choice else inputs
        expected = agent.net(inputs).numpy()
        strongest = agent.net.firing_strengths(inputs.double()).argmax(1).numpy()
    np.testing.assert_allclose(found[:, :count], expected, atol=5e-5)
    assert (found[:, count] == strongest).mean() > 0.99


LEARNED = sorted((Path(__file__).parent / "learned").glob("*.json"))
"""Of each learner a run of 200 trials in the maze (seed 0), reduced to 40 rules and exported."""
each_learned = pytest.mark.parametrize("file", LEARNED, ids=lambda file: file.stem)


def equal_to_the_model(folder, kind, count):
    """The compiled header in whole numbers and its model answer alike at inputs by chance."""
    _, data, _ = header(folder, kind, "int16", axes_only=True)
    compare(folder, data, count)


def learned(folder, file):
    """The header policy.h of a learned policy in whole numbers; the neutral policy."""
    data = policy.from_json(file)
    (folder / "policy.h").write_bytes(c.to_header(data, folder / "policy.h", "int16"))
    return data


def compare(folder, data, count):
    model, rng = fixed.make(data), np.random.default_rng(5)
    most = [65535 if axis["period"] else 32767 for axis in data["axes"]]
    x = rng.integers(0, most, (count, len(most)), endpoint=True).astype(np.uint16)
    numbers = 1 if data["discrete"] or data["decision"]["kind"] == "values" else model.conclusions
    call = "policy_action(x, out);"
    if data["discrete"] or data["decision"]["kind"] == "values":
        call = "out[0] = policy_action(x);"
    main = program(folder, "uint16_t", len(most), f"uint16_t out[{numbers}]; {call}")
    found = answers(main, x, np.uint16)
    for part, start in zip(np.array_split(x, 1 + count // 50_000), starts(count), strict=True):
        expected = model.act(part.astype(np.uint32)).reshape(len(part), -1)
        np.testing.assert_array_equal(found[start : start + len(part)], expected)


def starts(count):
    lengths = [len(part) for part in np.array_split(np.arange(count), 1 + count // 50_000)]
    return np.cumsum([0, *lengths[:-1]])


@needs_gcc
@pytest.mark.parametrize("kind", ALL)
def test_the_header_in_whole_numbers_is_its_model_bit_for_bit(tmp_path, kind):
    equal_to_the_model(tmp_path, kind, 3000)


@needs_gcc
@pytest.mark.parametrize("count", [3000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@each_learned
def test_a_learned_policy_in_whole_numbers_is_its_model_bit_for_bit(tmp_path, file, count):
    compare(tmp_path, learned(tmp_path, file), count)


@each_learned
def test_learned_rules_in_bytes_decide_as_the_network_at_98_of_100_states(file):
    """Around the rules, which lie where the robot goes."""
    data, rng = policy.from_json(file), np.random.default_rng(3)
    ours, model = runtime.Policy(data), fixed.make(data)
    assert model.bits == 8
    near = rng.integers(0, len(ours.centres), 1000)
    x = ours.centres[near] + 0.5 * ours.widths[near] * rng.normal(size=(1000, 3))
    low, high = (np.array([axis[end] for axis in data["axes"]]) for end in ("low", "high"))
    x[:, :2] = x.clip(low, high)[:, :2]
    assert (model.actions(model.inputs(x)) == [ours.act(state) for state in x]).mean() > 0.98


@pytest.mark.parametrize("trials", [1, pytest.param(20, marks=pytest.mark.slow)])
@each_learned
def test_learned_rules_in_bytes_drive_as_the_policy_in_python_does(file, trials):
    data = policy.from_json(file)
    ours, model = runtime.Policy(data), fixed.make(data)
    answers = ours.act, lambda state: int(model.actions(model.inputs([state]))[0])
    steps = []
    for act in answers:
        env = make_env(Config())
        env.reset(seed=1000)
        taken = []
        for _ in range(trials):
            (state, info), over = env.reset(), False
            while not over:
                state, _, *ends, info = env.step(act(state))
                over = any(ends)
            taken.append(info["total_steps"])
            assert info["success"]
        steps.append(taken)
    assert steps[0] == steps[1]


@needs_gcc
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["three", "wheels", "q", "q antecedent"])
def test_the_header_in_whole_numbers_is_its_model_at_a_million_states(tmp_path, kind):
    equal_to_the_model(tmp_path, kind, 1_000_000)


@pytest.mark.parametrize("kind", ALL)
def test_whole_numbers_decide_as_the_network_but_near_an_edge(kind):
    config, agent = learner(kind, axes_only=True)
    data = policy.describe(config, agent)
    model, ours, x = fixed.make(data), runtime.Policy(data), states(agent, 2000)
    low, high = (np.array([axis[end] for axis in data["axes"]]) for end in ("low", "high"))
    x = x.clip(low, high).astype(np.float32)
    found = model.actions(model.inputs(x))
    expected = np.array([ours.act(state) for state in x])
    if data["decision"]["kind"] == "normal" and not data["discrete"]:
        assert np.abs(found - expected).max() < 0.06
    else:
        different = (np.abs(found - expected) > 1e-6).reshape(len(x), -1).any(1)
        assert different.mean() < 0.03 and (margins(ours, x)[different] < 0.1).all()


def test_rules_that_share_their_widths_need_one_row_of_gains(tmp_path):
    config, agent = learner("three")
    agent.net.replace_rules(
        agent.net.centres, torch.full_like(agent.net.centres, 0.1), agent.net.consequents
    )
    data, path = policy.describe(config, agent), tmp_path / "policy.h"
    path.write_bytes(c.to_header(data, path, "int16"))
    assert "uint16_t policy_gains[1][3]" in path.read_text()
    back = c.from_header(path)["fixed"]
    np.testing.assert_array_equal(back.centres, fixed.make(data).centres)
    np.testing.assert_array_equal(back.concluded, fixed.make(data).concluded)
    np.testing.assert_array_equal(back.gains, fixed.make(data).gains)


def test_whole_numbers_refuse_in_one_line_what_they_cannot_hold(tmp_path):
    config, agent = learner("three")
    narrow = torch.full_like(agent.net.centres, 0.002)
    agent.net.replace_rules(agent.net.centres, narrow, agent.net.consequents)
    with pytest.raises(ValueError, match=r"rules on heading as narrow as .* --precision float"):
        fixed.make(policy.describe(config, agent))
    with pytest.raises(ValueError, match="c_x"):
        fixed.make(policy.describe(*learner("q antecedent")))


@pytest.mark.parametrize("precision", ["float", "int16"])
@pytest.mark.parametrize("kind", ["wheels", "q", "q antecedent", "pole q"])
def test_a_header_is_read_and_written_again(tmp_path, kind, precision, command):  # noqa: F811
    path, data, _ = header(tmp_path, kind, precision, axes_only=True)
    first = path.read_bytes()
    path.rename(tmp_path / "first.h")
    code, out, _ = command(tmp_path / "first.h", "--to", path)
    assert code == 0 and "40 rules" in out and path.read_bytes() == first
    if precision == "float":
        assert c.from_header(path)["rules"] == data["rules"]
    else:
        code, _, error = command(path, "--to", tmp_path / "policy.json")
        assert code == 2 and "holds rounded numbers" in error


def cut(text):
    return text[: len(text) // 2]


SPOILT = {
    "truncated": cut,
    "without its end": lambda text: text.replace("#endif", ""),
    "without its head": lambda text: text.replace("/* sofnn-torch policy", "/* policy"),
    "a head that is no JSON": lambda text: text.replace('"version": 1', '"version" 1'),
    "a short rule": lambda text: re.sub(
        r"((?:centres|rules)\[[^{]*\{\n    \{)[^,]*, ", r"\1", text, count=1
    ),
    "short rules": lambda text: re.sub(r"(\n    \{)[^,]*, ", r"\1", text),
    "another file": lambda _: "int main(void) { return 0; }\n",
}


@pytest.mark.parametrize("precision", ["float", "int16"])
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT.keys())
def test_a_spoilt_header_is_one_line(tmp_path, spoil, precision, command):  # noqa: F811
    path, _, _ = header(tmp_path, "three", precision)
    path.write_text(spoil(path.read_text()))
    code, _, error = command(path, "--to", tmp_path / "new.h")
    assert code == 2 and error.count("\n") == 1 and str(path) in error


def test_names_in_a_task_cannot_end_the_comments_of_a_header(tmp_path):
    config, agent = learner("car")
    name = "*/ int x; /* ??/"
    config = dataclasses.replace(config, axes=((name, "m", -1.2, 0.6, 0.0), config.axes[1]))
    agent.task = config.task
    path = tmp_path / "policy.h"
    path.write_bytes(c.to_header(policy.describe(config, agent), path, "int16"))
    assert c.from_header(path)["axes"][0]["name"] == name
    if shutil.which("gcc"):
        program(tmp_path, "uint16_t", 2, "uint16_t out[1] = {policy_action(x)};")


RULES = Path(__file__).parents[1] / "examples" / "rules"


@needs_gcc
@pytest.mark.parametrize("precision", [pytest.param("float", marks=pytest.mark.slow), "int16"])
@pytest.mark.parametrize("agent", ["sga", pytest.param("q", marks=pytest.mark.slow)])
def test_the_header_drives_through_the_maze_as_the_policy_in_python_does(
    tmp_path, agent, precision
):
    """Ten rules by hand, compiled as a library, without the way out of loops."""
    config = Config(agent=agent, rules=RULES / f"{agent}.csv")
    data, path = policy.describe(config, make_agent(config)), tmp_path / "policy.h"
    path.write_bytes(c.to_header(data, path, precision))
    number = {"float": "float", "int16": "uint16_t"}[precision]
    source = tmp_path / "policy.c"
    source.write_text(
        f'#include "policy.h"\nint decide(const {number} x[3]);\n'
        f"int decide(const {number} x[3]) {{ return (int)policy_action(x); }}\n"
    )
    shared = tmp_path / "policy.so"
    subprocess.run(
        ["gcc", "-O2", *STRICT, "-shared", "-fPIC", source, "-o", shared, "-lm"], check=True
    )
    decide = ctypes.CDLL(str(shared)).decide
    ours = runtime.Policy(data)
    model = fixed.make(data) if precision == "int16" else None
    env = make_env(config)

    def compiled(x):
        given = model.inputs(x[None])[0].astype(np.uint16) if model else x.astype(np.float32)
        return decide(given.ctypes.data_as(ctypes.c_void_p))

    def trial(act):
        x, info = env.reset(seed=4)
        done = False
        while not done:
            x, _, arrived, cut, info = env.step(act(x))
            done = arrived or cut
        return arrived, info["total_steps"]

    (arrived, steps), (expected, count) = trial(compiled), trial(ours.act)
    env.close()
    assert arrived and expected
    assert steps == count if precision == "float" else abs(steps - count) < 0.05 * count


# --------------------------------------------------------------------------- small machines

AVR = ("avr-gcc", "-mmcu=atmega328p", "-Os")
ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m0", "-mthumb", "-Os")
COUNT = 20  # states that a small machine is asked


def decisions(data, number="uint16_t"):
    """C text: some states, and what the model answers there."""
    rng = np.random.default_rng(2)
    most = [65535 if axis["period"] else 32767 for axis in data["axes"]]
    x = rng.integers(0, most, (COUNT, len(most)), endpoint=True)
    rows = ", ".join("{" + ", ".join(map(str, row)) + "}" for row in x.tolist())
    text = f"static const {number} states[{COUNT}][{len(most)}] = {{{rows}}};\n"
    return text, fixed.make(data).act(x.astype(np.uint32)).tolist()


def size(compiler, folder, code):
    """Bytes of program and tables that a call of the policy adds to an empty program."""
    sizes = []
    for name, text in (("empty", "y = x[0];"), ("full", code)):
        source, linked = folder / f"{name}.c", folder / f"{name}.elf"
        source.write_text(
            '#include <stdint.h>\n#include "policy.h"\nvolatile uint16_t x[3], y;\n'
            "int main(void) {\n    uint16_t s[3] = {x[0], x[1], x[2]};\n    (void)s;\n"
            f"    {text}\n    return 0;\n}}\n"
        )
        links = ["-nostartfiles", "-Wl,--entry=main"] if "arm" in compiler[0] else []
        call = [*compiler, "-std=c99", *links, source, "-o", linked]
        subprocess.run(call, check=True, capture_output=True)
        tool = compiler[0].replace("gcc", "size")
        out = subprocess.run([tool, linked], check=True, capture_output=True, text=True).stdout
        sizes.append(sum(map(int, out.splitlines()[1].split()[:2])))  # text and data
    return sizes[1] - sizes[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compiler", "shared"),
    [
        pytest.param(AVR, True, marks=needs("avr-gcc"), id="AVR"),
        pytest.param(AVR, False, marks=needs("avr-gcc"), id="AVR, own widths"),
        pytest.param(ARM, True, marks=needs("arm-none-eabi-gcc"), id="Cortex-M0"),
        pytest.param(ARM, False, marks=needs("arm-none-eabi-gcc"), id="Cortex-M0, own widths"),
    ],
)
def test_a_policy_of_forty_rules_in_whole_numbers_takes_a_kilobyte(tmp_path, compiler, shared):
    """Learning by default leaves all rules the same widths."""
    config, agent = learner("three")
    if shared:
        widths = torch.full_like(agent.net.centres, 0.1)
        agent.net.replace_rules(agent.net.centres, widths, agent.net.consequents)
    path = tmp_path / "policy.h"
    path.write_bytes(c.to_header(policy.describe(config, agent), path, "int16"))
    assert f"policy_gains[{1 if shared else 40}][3]" in path.read_text()
    bytes_taken = size(compiler, tmp_path, "y = policy_action(s);")
    print(f"{bytes_taken} bytes")
    assert 320 < bytes_taken <= 1024


@pytest.mark.slow
@pytest.mark.parametrize(
    "compiler",
    [
        pytest.param(AVR, marks=needs("avr-gcc"), id="AVR"),
        pytest.param(ARM, marks=needs("arm-none-eabi-gcc"), id="Cortex-M0"),
    ],
)
@each_learned
def test_a_learned_policy_of_forty_rules_takes_a_kilobyte(tmp_path, compiler, file):
    """Reduced rules have widths of their own, which vary more than ten times."""
    data = learned(tmp_path, file)
    assert len(data["rules"]) == 40
    bytes_taken = size(compiler, tmp_path, "y = policy_action(s);")
    print(f"{bytes_taken} bytes")
    assert 400 < bytes_taken <= 1024


@pytest.mark.slow
@needs("avr-gcc", "simavr")
def test_an_avr_decides_as_the_model_within_a_few_milliseconds(tmp_path):
    """Timer 1 counts every eighth cycle of 16 MHz."""
    _, data, _ = header(tmp_path, "three", "int16")
    text, expected = decisions(data)
    (tmp_path / "main.c").write_text(
        "#include <avr/io.h>\n#include <avr/interrupt.h>\n#include <avr/sleep.h>\n"
        "#include <stdio.h>\n"
        f'#include "policy.h"\n{text}'
        "static int put(char c, FILE *f) { (void)f; while (!(UCSR0A & (1 << UDRE0))); UDR0 = c;"
        " return 0; }\nstatic FILE out = FDEV_SETUP_STREAM(put, NULL, _FDEV_SETUP_WRITE);\n"
        "int main(void) {\n    int i;\n    UCSR0B = 1 << TXEN0;\n    stdout = &out;\n"
        f"    TCCR1B = 1 << CS11;\n    for (i = 0; i < {COUNT}; i++) {{\n"
        "        uint16_t before = TCNT1, action = policy_action(states[i]);\n"
        '        uint16_t after = TCNT1;\n        printf("%u %u\\n", action, after - before);\n'
        "    }\n    cli();\n    sleep_mode();\n    return 0;\n}\n"
    )
    elf = tmp_path / "main.elf"
    clock = "-DF_CPU=16000000UL"
    subprocess.run([*AVR, clock, "-std=gnu99", tmp_path / "main.c", "-o", elf], check=True)
    call = ["simavr", "-m", "atmega328p", "-f", "16000000", elf]
    said = subprocess.run(call, capture_output=True, text=True, timeout=120)
    pairs = re.findall(r"(\d+) (\d+)\.", said.stdout + said.stderr)
    assert [int(action) for action, _ in pairs] == expected
    slowest = max(int(ticks) for _, ticks in pairs) * 8 / 16e6
    print(f"slowest decision: {1000 * slowest:.2f} ms at 16 MHz")
    assert slowest < 0.005


VECTORS = """\
extern unsigned char stack_top[];
void start(void);
__attribute__((section(".vectors"), used)) void (*const vectors[2])(void) = {
    (void (*)(void))stack_top, start};
static void call(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}
void start(void) {
    int i;
    char digits[2] = {0, 0};
    for (i = 0; i < COUNT; i++) {
        digits[0] = (char)('0' + policy_action(states[i]));
        call(4, digits); /* write a text */
    }
    call(0x18, (void *)0x20026); /* end */
    for (;;) {}
}
"""
PLACES = """\
SECTIONS {
  .text 0 : { *(.vectors) *(.text*) *(.rodata*) }
  .data 0x20000000 : { *(.data*) *(.bss*) }
  stack_top = 0x20004000;
}
"""


@pytest.mark.slow
@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m_decides_as_the_model(tmp_path):
    _, data, _ = header(tmp_path, "three", "int16")
    text, expected = decisions(data)
    main = f'#include <stdint.h>\n#include "policy.h"\nenum {{ COUNT = {COUNT} }};\n{text}{VECTORS}'
    (tmp_path / "main.c").write_text(main)
    (tmp_path / "places.ld").write_text(PLACES)
    elf = tmp_path / "main.elf"
    compiler = ("arm-none-eabi-gcc", "-mcpu=cortex-m3", "-mthumb", "-Os", "-std=gnu99")
    links = ["-nostdlib", "-T", tmp_path / "places.ld"]
    subprocess.run([*compiler, tmp_path / "main.c", *links, "-lgcc", "-o", elf], check=True)
    machine = ["-M", "lm3s6965evb", "-nographic", "-semihosting-config", "enable=on,target=native"]
    call = ["qemu-system-arm", *machine, "-kernel", elf]
    said = subprocess.run(call, capture_output=True, text=True, timeout=60)
    digits = re.findall(r"^[0-2]+$", said.stdout + said.stderr, re.MULTILINE)
    assert digits == ["".join(map(str, expected))]
