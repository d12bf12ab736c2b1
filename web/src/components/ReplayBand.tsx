// SPDX-License-Identifier: Apache-2.0
// The band of a replay: what is shown and when it was, play, speed, the track with its marks, back to live.

import { robotPose } from "../map/robot_pose";
import { SPEEDS } from "../replay_player";
import { player } from "../replay";
import { type OpenedReplay, type ReplayMark } from "../records";
import { replayStamp } from "../state";
import { clockText, reasonText, t } from "../texts";
import { capital } from "../why";
import { Button, Choice, IconButton } from "./controls";

export function ReplayBand() {
  const opened = player.opened.value;
  const { opening } = player;
  if (opened === null && opening.value === "") return null;
  return (
    <section class="replay card" aria-label={t("replay")}>
      <header class="replay-head">
        <div role="status">
          <h2>{opened === null ? t("replay_loading", { name: opening.value }) : t("replay_of", { name: opened.name })}</h2>
        </div>
        <Button label={t("back_to_live")} kind="primary" onClick={() => player.close()} />
      </header>
      {opened !== null && <Track opened={opened} />}
    </section>
  );
}

function Track({ opened }: { opened: OpenedReplay }) {
  const { position, playing, speed } = player;
  const time = timeText(position.value);
  return (
    <>
      <div class="replay-track">
        <input
          type="range"
          min="0"
          max={opened.length}
          step="any"
          value={position.value}
          aria-label={t("replay_time")}
          aria-valuetext={time}
          onInput={(event) => player.seek(Number(event.currentTarget.value))}
          onKeyDown={(event) => {
            const step = STEPS_S[event.key];
            if (step === undefined) return;
            event.preventDefault();
            player.seek(position.peek() + step);
          }}
        />
        {opened.marks.length > 0 && (
          <div class="replay-marks">
            {opened.marks.map((mark, i) => (
              <Mark key={i} mark={mark} length={opened.length} />
            ))}
          </div>
        )}
      </div>
      <div class="replay-row">
        <IconButton
          label={t(playing.value ? "replay_pause" : "replay_play")}
          icon={playing.value ? "hold" : "play"}
          onClick={() => player.toggle()}
        />
        <span class="number replay-clock">
          {time} / {timeText(opened.length)}
        </span>
        <span class="number muted">{clockText((opened.begin + position.value) * 1e3)}</span>
        <PoseText />
        <Choice
          label={t("replay_speed")}
          value={speed.value}
          options={SPEEDS.map((factor) => [factor, `${factor}×`] as const)}
          onChange={(factor) => (speed.value = factor)}
        />
      </div>
    </>
  );
}

/** s that a key moves the time. Without steps of the browser's, which `any` makes far too long. */
const STEPS_S: Readonly<Record<string, number | undefined>> = {
  ArrowLeft: -1,
  ArrowDown: -1,
  ArrowRight: 1,
  ArrowUp: 1,
  PageDown: -10,
  PageUp: 10,
};

/** Where the robot was on the map. */
function PoseText() {
  void replayStamp.value;
  const pose = robotPose();
  if (pose === null) return null;
  const degrees = Math.round((pose[2] * 180) / Math.PI);
  return <span class="number muted replay-pose">{`x ${pose[0].toFixed(2)} m · y ${pose[1].toFixed(2)} m · ${degrees || 0}°`}</span>;
}

function Mark({ mark, length }: { mark: ReplayMark; length: number }) {
  const words = mark.kind === "fault" ? capital(reasonText(mark.reason).text) : mark.text;
  const label = `${timeText(mark.t)} ${words}`;
  return (
    <button
      type="button"
      class={`replay-mark ${mark.kind}`}
      style={{ left: `${(100 * mark.t) / Math.max(length, 1e-9)}%` }}
      title={label}
      aria-label={label}
      onClick={() => player.seek(mark.t)}
    />
  );
}

/** "1:02.5" of s. */
function timeText(seconds: number): string {
  const tenths = Math.floor(seconds * 10);
  const whole = Math.floor(tenths / 10);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}.${tenths % 10}`;
}
